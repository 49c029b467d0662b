"""The machine that a benchmark ran on, and the memory that a call takes."""

from __future__ import annotations

import ctypes
import os
import platform
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np

from services.cli.bench import THREADS
from tests.benchmarks.results import Record

_PROCESS: Final = Path("/proc/self")


def machine() -> Record:
    """Describe the machine, and how many threads the libraries were given (None: as many as they like)."""
    return {
        "cpu": _cpu(),
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "numpy": np.__version__,
        "threads": {name: os.environ.get(name) for name in THREADS},
    }


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "unknown")


def peak_memory_increase(call: Callable[[], object]) -> int | None:
    """Call, and return by how many bytes the resident memory rose at most; None where Linux and glibc do not tell."""
    try:
        ctypes.CDLL(None).malloc_trim(0)  # or memory that earlier calls gave back would be used again unseen
        (_PROCESS / "clear_refs").write_text("5")  # the peak starts anew
        before = _resident("VmRSS")
        call()
        return max(0, _resident("VmHWM") - before)
    except (OSError, AttributeError, StopIteration):
        return None


def _resident(name: str) -> int:
    lines = (_PROCESS / "status").read_text().splitlines()
    return 1024 * int(next(line.split()[1] for line in lines if line.startswith(name)))
