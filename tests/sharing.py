"""What is costly to make is made once a run of the tests, however many processes share the work."""

import fcntl
import os
from collections.abc import Callable
from pathlib import Path

import pytest


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], None]) -> Path:
    """Return a folder that ``make`` has filled, in this process or, while this one waited, in another.

    Parameters
    ----------
    factory
        Where this process has its folders.
    name
        The folder's, and no other's.
    make
        Fills the empty folder.
    """

    def made() -> Path:
        folder = factory.mktemp(name)
        make(folder)
        return folder

    if "PYTEST_XDIST_WORKER" not in os.environ:
        return made()
    # Each process has a folder of its own in that of the run.
    where = factory.getbasetemp().parent / f"{name}.path"
    with where.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not where.exists():
            where.write_text(str(made()))
    return Path(where.read_text())
