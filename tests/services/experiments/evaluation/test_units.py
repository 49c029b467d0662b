"""Units are done once, in an order in which they can be; their results are kept, and never taken for others."""

from __future__ import annotations

import multiprocessing
import os
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from services.experiments.evaluation import pool
from services.experiments.evaluation import units as of_plan
from services.experiments.evaluation.plan import PLANS, Criterion, Plan, in_world
from services.experiments.evaluation.results import Results, file_of
from services.experiments.evaluation.units import Unit, sources, units, whole_series
from services.kit.errors import JobError
from tests.services.experiments.evaluation.evaluated import SMALL, finding

PLANNED = units(SMALL)


@pytest.mark.parametrize("chosen", [*PLANS.values(), SMALL, in_world("yard", 1.5)], ids=lambda one: one.name)
def test_every_unit_comes_once_and_after_those_that_it_needs(chosen: Plan) -> None:
    done: set[Unit] = set()
    for unit in units(chosen):
        assert unit not in done
        assert set(unit.needs) <= done
        done.add(unit)
    assert len({unit.digest for unit in done}) == len(done)


def test_another_setting_map_or_code_is_another_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def digests(one: Plan, kind: str) -> set[str]:
        return {unit.digest for unit in units(one) if unit.kind == kind}

    (world,) = SMALL.worlds
    otherwise = replace(SMALL, worlds=(replace(world, drives=4, criteria=(Criterion(2.0, 25.0),)),))
    assert not digests(SMALL, "recognize") & digests(otherwise, "recognize")
    for kind in ("teach", "learn", "recognize", "objective", "search"):
        assert not digests(SMALL, kind) & digests(replace(SMALL, camera=(128, 96)), kind)
    shorter = replace(SMALL, patience=1.5)
    assert not digests(SMALL, "search") & digests(shorter, "search")
    assert digests(SMALL, "recognize") == digests(shorter, "recognize")
    named = {path.name for path in sources()}
    assert {"filter.py", "search.py", "work.py", "indoor.json"} <= named
    assert not {"page.py", "figures.py", "results.py"} & named
    file = tmp_path / "town.json"
    file.write_text("one map")
    one_map = digests(in_world(str(file), 1.5), "search")
    file.write_text("another one")
    assert not digests(in_world(str(file), 1.5), "search") & one_map
    before = digests(SMALL, "search")
    monkeypatch.setattr(of_plan, "code_fingerprint", lambda: "other")
    assert not digests(SMALL, "search") & before


def test_what_was_found_out_is_there_again_with_the_file_that_it_left(tmp_path: Path) -> None:
    results = Results(tmp_path, PLANNED)
    for unit in PLANNED[:10]:
        results.add(unit, finding(unit) | {"file": unit is PLANNED[0]})
    assert PLANNED[0] not in Results(tmp_path, PLANNED).findings
    file_of(results.work, PLANNED[0]).touch()
    assert Results(tmp_path, PLANNED).findings == results.findings
    assert set(whole_series(PLANNED, results.findings)) < set(PLANNED[:10]) | {PLANNED[0]}
    (results.work / f"{PLANNED[3].digest}.json").write_text("{")
    with pytest.raises(JobError, match=r"\.json: is no result; delete it"):
        Results(tmp_path, PLANNED)


def killed_at_the_second(unit: Unit, _folder: Path) -> dict[str, Any]:
    if unit.needs:
        os.kill(os.getpid(), signal.SIGKILL)
    return {}


def test_a_worker_that_is_killed_is_one_line_and_what_was_done_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pool, "_do", killed_at_the_second)
    first = Unit("teach", (("seed", 1),))
    done: list[Unit] = []
    with pytest.raises(JobError, match=r"a worker was killed, .* at learn/length=1 or beside it; run again to go on"):
        pool.do_all(
            [first, Unit("learn", (("length", 1),), (first,))], (), tmp_path, 2, lambda unit, _: done.append(unit)
        )
    assert done == [first]
    assert multiprocessing.active_children() == []
