"""A worker that is killed is one line, and what was done before is kept."""

from __future__ import annotations

import multiprocessing
import os
import signal
from pathlib import Path

import pytest

from services.experiments.evaluation import worker_pool as workers
from services.experiments.evaluation.plan import Plan
from services.experiments.evaluation.schedule import Unit
from services.kit.errors import JobError

UNITS = [Unit("teach", "yard", (("seed", 1),)), Unit("learn", "yard", (), needs=("teach/yard/seed=1",))]


def killed_at_the_second(_plan: Plan, _folder: Path, unit: Unit) -> workers.Found:
    if unit.needs:
        os.kill(os.getpid(), signal.SIGKILL)
    return {}, 0.0


def test_a_worker_that_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "_do", killed_at_the_second)
    done: list[str] = []
    with pytest.raises(JobError, match=r"a worker was killed, .* at learn/yard or beside it; run again to go on"):
        workers.do_all(Plan("none", ()), UNITS, set(), tmp_path, 2, lambda unit, *_: done.append(unit.key))
    assert done == ["teach/yard/seed=1"]
    assert multiprocessing.active_children() == []
