"""The command line of a benchmark: the flags that all have, and errors of one line."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from services.cli import outputs
from services.cli.interrupts import interrupted_by_signals
from services.kit.errors import JobError, UsageError, describe_os_error
from services.kit.node import EXIT_FAILED, EXIT_USAGE


class Parser(argparse.ArgumentParser):
    """The flags of every benchmark; a mistake is a UsageError.

    Parameters
    ----------
    name : str
        Of the benchmark.
    description : str or None
    """

    def __init__(self, name: str, description: str | None) -> None:
        super().__init__(f"smal bench {name}", description=description, allow_abbrev=False)
        self.add_argument("--json", type=Path, metavar="FILE", help="write the results as JSON")
        self.add_argument("--out", type=Path, metavar="DIR", help="folder for pictures")
        self.add_argument("--quick", action="store_true", help="a small run of about a minute")

    def parse(self, arguments: list[str]) -> argparse.Namespace:
        """Read the flags, and check that the results can be written, before the work begins."""
        flags = self.parse_args(arguments)
        outputs.check_file(flags.json, "--json")
        if flags.out is not None:
            outputs.make_folder(flags.out, "--out")
        return flags

    def error(self, message: str) -> NoReturn:
        """Raise, where argparse would print several lines."""
        raise UsageError(message)


def run_benchmark(main: Callable[[list[str]], None]) -> NoReturn:
    """Run a benchmark with the arguments of this process, and exit."""
    status = 0
    try:
        with interrupted_by_signals():
            main(sys.argv[1:])
    except UsageError as error:
        status = _say(str(error), EXIT_USAGE)
    except JobError as error:
        status = _say(str(error), EXIT_FAILED)
    except OSError as error:
        status = _say(describe_os_error(error), EXIT_FAILED)
    except KeyboardInterrupt:
        status = 130  # `smal bench` says it
    sys.exit(status)


def _say(message: str, status: int) -> int:
    sys.stderr.write(f"smal: {message}\n")
    return status
