"""Run a benchmark: ``smal bench NAME``."""

from __future__ import annotations

import importlib
import sys
from typing import NoReturn

from services.cli.interrupts import interrupted_by_signals
from services.kit.errors import JobError, UsageError, describe_os_error
from services.kit.process import EXIT_FAILED, EXIT_USAGE


def run(name: str, arguments: list[str]) -> NoReturn:
    """Run one of the packages beside this file, and exit."""
    status = 0
    try:
        with interrupted_by_signals():
            importlib.import_module(f"tests.benchmarks.{name}.benchmark").main(arguments)
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


if __name__ == "__main__":
    run(sys.argv[1], sys.argv[2:])
