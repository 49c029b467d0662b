"""Units are named by all that determines them; what is done is kept, whatever becomes of a worker."""

import multiprocessing
import os
import signal
from dataclasses import replace
from pathlib import Path

import pytest

from services.experiments.evaluation import units as of_plan
from services.experiments.evaluation.plan import Criterion, Plan, in_world
from services.experiments.evaluation.results import Results
from services.experiments.evaluation.units import Finding, Learn, Site, Teach, units
from services.kit.errors import JobError
from tests.services.experiments.evaluation.evaluated import SMALL, finding

PLANNED = units(SMALL)


def test_each_unit_is_once_and_after_those_that_it_needs() -> None:
    assert len(set(PLANNED)) == len(PLANNED)
    for number, unit in enumerate(PLANNED):
        assert set(unit.needs) <= set(PLANNED[:number])


def test_another_setting_map_or_code_is_another_result_and_the_rest_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def names(one: Plan, kind: str) -> set[str]:
        return {unit.name for unit in units(one) if type(unit).__name__ == kind}

    (world,) = SMALL.worlds
    otherwise = replace(SMALL, worlds=(replace(world, drives=4, criterion=Criterion(2.0, 25.0)),))
    assert not names(SMALL, "Recognize") & names(otherwise, "Recognize")
    for kind in ("Teach", "Learn", "Recognize", "Searches"):
        assert not names(SMALL, kind) & names(replace(SMALL, camera=(128, 96)), kind)
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


def test_what_was_found_out_is_there_again_with_the_file_that_it_left(tmp_path: Path) -> None:
    results = Results(tmp_path, PLANNED)
    for unit in PLANNED[:10]:
        results.add(unit, finding(unit) | {"file": unit is PLANNED[0]})
    assert PLANNED[0] not in Results(tmp_path, PLANNED).findings
    PLANNED[0].file(results.work).touch()
    assert Results(tmp_path, PLANNED).findings == results.findings
    (results.work / f"{PLANNED[3].name}.json").write_text("{")
    with pytest.raises(JobError, match=r"\.json: is no result; delete it"):
        Results(tmp_path, PLANNED)


class KilledLater(Learn):
    """Needs a drive, and is killed."""

    def do(self, _folder: Path) -> Finding:
        """End this process."""
        os.kill(os.getpid(), signal.SIGKILL)
        return {}


def test_a_worker_that_is_killed_is_one_line_and_what_was_done_is_kept(tmp_path: Path) -> None:
    results = Results(tmp_path, [])
    site = Site("yard", "", (64, 48))
    first = Teach(site, (), 1)
    results.add(first, {})
    with pytest.raises(JobError, match=r"a worker was killed, .* at killedlater in yard or beside it; run again to go"):
        results.complete([first, KilledLater(site, (first,), 0)], 2, lambda: None)
    assert list(results.findings) == [first]
    assert multiprocessing.active_children() == []
