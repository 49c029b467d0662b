"""Units are named by all that determines them; what is done is kept, whatever becomes of a worker."""

import multiprocessing
import os
import signal
from dataclasses import replace
from pathlib import Path

import pytest

from services.experiments import engine as engines
from services.experiments.engine import Engine
from services.experiments.evaluation import units as of_plan
from services.experiments.evaluation.drivers import DriverError
from services.experiments.evaluation.plan import Criterion, EvaluationPlan, in_world, with_each
from services.experiments.evaluation.results import Results
from services.experiments.evaluation.units import Finding, LearnUnit, Searches, Site, Teach, units
from services.kit.errors import JobError
from tests.services.experiments.evaluation.evaluated import SMALL, finding

PLANNED = units(SMALL)


def test_each_unit_is_once_and_after_those_that_it_needs() -> None:
    assert len(set(PLANNED)) == len(PLANNED)
    for number, unit in enumerate(PLANNED):
        assert set(unit.needs) <= set(PLANNED[:number])


def test_results_are_kept_unless_their_inputs_change(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def names(one: EvaluationPlan, kind: str) -> set[str]:
        return {unit.name for unit in units(one) if type(unit).__name__ == kind}

    (world,) = SMALL.worlds
    otherwise = replace(SMALL, worlds=(replace(world, drives=4, criterion=Criterion(2.0, 25.0)),))
    assert not names(SMALL, "Recognize") & names(otherwise, "Recognize")
    for kind in ("Teach", "TeachDriver", "Recognize", "Searches"):
        assert not names(SMALL, kind) & names(replace(SMALL, camera=(128, 96)), kind)
        assert not names(SMALL, kind) & names(replace(SMALL, base="car"), kind)
    shorter = replace(SMALL, patience=1.5)
    assert not names(SMALL, "Searches") & names(shorter, "Searches")
    assert names(SMALL, "Recognize") == names(shorter, "Recognize")
    file = tmp_path / "town.json"
    file.write_text("one map")
    one_map = names(in_world(str(file), 1.5), "Searches")
    file.write_text("another one")
    assert not names(in_world(str(file), 1.5), "Searches") & one_map
    before = names(SMALL, "Searches")
    monkeypatch.setattr(of_plan, "code_fingerprint", lambda: "other")
    assert not names(SMALL, "Searches") & before


def test_plan_compares_reduced_smal_when_ways_are_obstructed() -> None:
    def drivers(one: EvaluationPlan) -> set[str]:
        return {unit.trial.driver for unit in units(one) if isinstance(unit, Searches)}

    free = in_world("campus", 1.5)
    assert drivers(free) == {"smal", "teach-and-repeat", "teach-and-repeat-told"}
    hindered = with_each(free, lambda trial: replace(trial, obstacles=3))
    assert drivers(hindered) == drivers(free) | {"smal-waits", "smal-unguarded"}


def test_results_and_files_are_read_back_when_resumed(tmp_path: Path) -> None:
    results = Results(tmp_path, PLANNED)
    for unit in PLANNED[:10]:
        results.add(unit, finding(unit) | {"file": unit is PLANNED[0]})
    assert PLANNED[0] not in Results(tmp_path, PLANNED).findings
    PLANNED[0].file(results.work).touch()
    assert Results(tmp_path, PLANNED).findings == results.findings
    (results.work / f"{PLANNED[3].name}.json").write_text("{")
    with pytest.raises(JobError, match=r"\.json: invalid result; delete it"):
        Results(tmp_path, PLANNED)


class Killed(Teach):
    """Kills the worker that does it: with seed 1 always, with seed 2 the first one."""

    def do(self, folder: Path) -> Finding:
        """End this process, or answer."""
        tried = folder / f"tried-{self.seed}"
        if self.seed == 1 or not tried.exists():
            tried.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return {"seed": self.seed}


class After(LearnUnit):
    """Needs a drive, and says what its worker knows of it."""

    def do(self, _folder: Path) -> Finding:
        """Say it."""
        return {"needs": len(self.needs), "threads": os.environ["OPENBLAS_NUM_THREADS"]}


class BadDriver(Teach):
    """Has a driver with an error."""

    def do(self, _folder: Path) -> Finding:
        """Raise the driver's error."""
        raise DriverError("driver a:B: teaching failed: ZeroDivisionError")


SITE = Site("yard", "", (64, 48))


def test_other_drivers_continue_when_one_driver_fails(tmp_path: Path) -> None:
    bad = [BadDriver(SITE, (), 1), BadDriver(SITE, (), 2)]
    after = After(SITE, (bad[0],), 0)
    others = [After(SITE, (), 1), After(SITE, (), 2)]
    results = Results(tmp_path, [])
    with Engine(1) as engine:
        failures = results.complete([*bad, after, *others], engine, lambda *_: None)
    assert failures == ["driver a:B: teaching failed: ZeroDivisionError"]
    assert {*results.findings} == {*others}


@pytest.mark.long
def test_unit_is_reported_when_it_kills_its_workers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engines, "_TRIES", 2)
    killed = Killed(SITE, (), 2)
    after = After(SITE, (killed,), 0)
    always = Killed(SITE, (after,), 1)
    results = Results(tmp_path, [])
    done = list[tuple[int, int]]()
    said = "^killed in yard: workers were killed, perhaps out of memory; run the command again to continue"
    with pytest.raises(JobError, match=said), Engine(2) as engine:
        results.complete([killed, after, always], engine, lambda *one: done.append(one))
    assert done == [(0, 3), (1, 3), (2, 3)]
    kept = Results(tmp_path, [killed, after, always]).findings
    found = [
        {name: value for name, value in one.items() if name != "cpu_s"} for one in kept.values()
    ]
    assert found == [{"seed": 2}, {"needs": 1, "threads": "1"}]
    assert multiprocessing.active_children() == []
