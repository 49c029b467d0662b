"""The command line of a benchmark: the flags that all have, and where their results go."""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

from services.cli import outputs
from services.kit.errors import UsageError
from tests.benchmarks.results import write_json


class Parser(argparse.ArgumentParser):
    """The flags of every benchmark; a mistake is a UsageError.

    Parameters
    ----------
    name : str
        Of the benchmark.
    description : str or None
    """

    def __init__(self, name: str, description: str | None) -> None:
        raw = argparse.RawDescriptionHelpFormatter
        super().__init__(f"smal bench {name}", description=description, formatter_class=raw, allow_abbrev=False)
        self.add_argument("--json", type=Path, metavar="FILE", help="write the results as JSON")
        self.add_argument("--out", type=Path, metavar="DIR", help="folder for pictures")
        self.add_argument("--quick", action="store_true", help="a small run of about a minute")

    def add_model(self) -> None:
        """Take a model for a robot that is to drive by itself (`faults.model`)."""
        self.add_argument("--model", type=Path, metavar="FILE", help="model of the world yard, camera 160x120; "
                          "without it one is taught first, in a minute or two")  # fmt: skip

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


def say(flags: argparse.Namespace, results: dict[str, Any], text: str) -> None:
    """Write the results where ``--json`` wants them, and print their tables."""
    if flags.json is not None:
        write_json(flags.json, {"quick": flags.quick, **results})
        text += f"\nresults: {flags.json}\n"
    sys.stdout.write(text)


@contextmanager
def folder_for(out: Path | None) -> Iterator[Path]:
    """Give the folder for logs and recordings; without ``--out`` it is removed again."""
    if out is not None:
        yield out
        return
    with tempfile.TemporaryDirectory(prefix="smal-bench-") as folder:
        yield Path(folder)
