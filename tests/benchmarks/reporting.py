"""What all benchmarks share: their flags, the machine, and results as JSON and as tables."""

import argparse
import json
import os
import platform
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, NoReturn

import numpy as np
import psutil

from services.cli import outputs
from services.experiments import words
from services.kit.errors import UsageError
from smal.files.container import replacing

#: Variables that set the threads of numerical libraries.
THREADS: Final = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
Record = dict[str, object]  # What a benchmark found out about one thing; JSON can hold it.


class Parser(argparse.ArgumentParser):
    """The flags of every benchmark; a mistake is a UsageError."""

    def __init__(self, name: str, description: str | None) -> None:
        raw = argparse.RawDescriptionHelpFormatter
        prog = f"python -m tests.benchmarks {name}"
        super().__init__(prog, description=description, formatter_class=raw, allow_abbrev=False)
        self.add_argument("--json", type=Path, metavar="FILE", help="write the results as JSON")
        self.add_argument("--out", type=Path, metavar="DIR", help="folder for pictures and logs")
        self.add_argument("--quick", action="store_true", help="a small run of about a minute")

    def add_model(self) -> None:
        """Take a model for a robot that is to drive by itself."""
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
        written = json.dumps(
            {"quick": flags.quick, "machine": machine(), **results}, indent=2, allow_nan=False
        )
        with replacing(flags.json) as file:
            file.write(written.encode() + b"\n")
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


def table(title: str, rows: Sequence[Mapping[str, object]]) -> str:
    """Lay records with the same keys out in columns, under a title; without rows nothing."""
    if not rows:
        return ""
    cells = [list(rows[0]), *([_shown(value) for value in row.values()] for row in rows)]
    return "\n".join(["", title, *words.table(cells), ""])


def _shown(value: object) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1000.0 else f"{value:.3g}"
    return f"{value:,}" if isinstance(value, int) else str(value)


def used(pid: int) -> tuple[float, float]:
    """Return the bytes that a process holds, and the processor seconds that it has taken."""
    process = psutil.Process(pid)
    times = process.cpu_times()
    return float(process.memory_info().rss), times.user + times.system


def verdict(target: str, measured: float, limit: float, unit: str = "") -> Record:
    """Compare with what is promised."""
    text = "met" if measured <= limit else "not met"
    return {
        "target": target,
        "measured": measured,
        "limit": f"at most {limit:g}{unit}",
        "verdict": text,
    }


def machine() -> Record:
    """Describe the machine, and how many threads the libraries were given (None: as many as they like)."""
    cpu = Path("/proc/cpuinfo")
    lines = cpu.read_text().splitlines() if cpu.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return {
        "cpu": names[0] if names else platform.processor(),
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "numpy": np.__version__,
        "threads": {name: os.environ.get(name) for name in THREADS},
    }
