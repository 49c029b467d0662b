"""A worker that ends, whenever it does, is one line."""

from __future__ import annotations

import multiprocessing
from multiprocessing.connection import Connection
from types import SimpleNamespace
from typing import cast

import pytest

from services.experiments.evaluation.units import Unit
from services.experiments.evaluation.workers import _give, _receive, _Worker
from services.kit.errors import JobError

UNIT = Unit("teach", "yard", (("seed", 1),))
LINE = "a worker ended with status -9 at teach/yard/seed=1; run again to go on"


def killed() -> tuple[_Worker, Connection]:
    """Return a worker whose process is gone, and the end of the pipe that was its own."""
    ours, theirs = multiprocessing.Pipe()
    process = SimpleNamespace(join=lambda: None, exitcode=-9)
    return _Worker(cast("multiprocessing.context.SpawnProcess", process), ours), theirs


def test_while_it_waits() -> None:
    worker, theirs = killed()
    theirs.close()
    with pytest.raises(JobError, match=LINE):
        _give(worker, [UNIT], set())


def test_before_it_answers() -> None:
    worker, theirs = killed()
    theirs.close()
    with pytest.raises(JobError, match=LINE):
        _receive(worker, UNIT)


def test_in_the_middle_of_an_answer() -> None:
    worker, theirs = killed()
    theirs._send(b"\x00\x00\x10\x00half")  # type: ignore[attr-defined]  # says 4096 bytes
    theirs.close()
    with pytest.raises(JobError, match=LINE):
        _receive(worker, UNIT)
