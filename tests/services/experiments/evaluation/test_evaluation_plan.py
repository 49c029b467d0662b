"""Plans come to units that are all different, in an order in which they can be done, and do what the issue asks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from services.experiments.evaluation import plan
from services.experiments.evaluation.plan import (
    FULL,
    PLANS,
    QUICK,
    Criterion,
    Plan,
    Trial,
    WorldPlan,
    in_world,
)
from services.experiments.evaluation.schedule import units
from tests.services.experiments.evaluation.evaluated import SMALL

CRITERIA = (Criterion(1.0, 25.0),)


@pytest.mark.parametrize("chosen", [*PLANS.values(), SMALL, in_world("yard", 1.5)], ids=lambda one: one.name)
def test_every_unit_comes_once_and_after_those_that_it_needs(chosen: Plan) -> None:
    done: set[str] = set()
    for unit in units(chosen):
        assert unit.key not in done
        assert set(unit.needs) <= done
        done.add(unit.key)


def test_nobody_is_taught_recoveries_and_all_have_the_same_drives() -> None:
    for unit in units(FULL):
        if unit.kind == "search":
            taught = [need for need in unit.needs if need.startswith("teach/")]
            assert taught == [f"teach/{unit.world}/camera=320x240/seed={1 + k}" for k in range(unit.number("drives"))]
            learns = unit["controller"] in {"smal", "paper"}
            assert [need.split("/")[0] for need in unit.needs].count("learn") == learns


def test_the_quick_plan_says_what_it_leaves_out_and_is_much_shorter() -> None:
    assert QUICK.omitted
    quick, full = (len(units(one)) for one in (QUICK, FULL))
    assert 5 * quick < full


def test_what_all_plans_have_in_common_is_part_of_their_fingerprint(monkeypatch: pytest.MonkeyPatch) -> None:
    before = FULL.fingerprint
    for name, other in (("JUDGED_TICKS", 1), ("PEER_RECOGNIZERS", ())):
        with monkeypatch.context() as patch:
            patch.setattr(plan, name, other)
            assert FULL.fingerprint != before, name
    monkeypatch.setitem(plan.CONTROLLERS, "smal", "another")
    assert FULL.fingerprint != before


def test_keys_change_with_what_was_taught_and_with_when_searches_time_out() -> None:
    def keys(one: Plan, kind: str) -> set[str]:
        return {unit.key for unit in units(one) if unit.kind == kind}

    (world,) = SMALL.worlds
    otherwise_taught = replace(SMALL, worlds=(replace(world, drives=4),))
    seen_larger = replace(SMALL, camera=(128, 96))
    assert not keys(SMALL, "recognize") & keys(otherwise_taught, "recognize")
    for kind in ("teach", "learn", "recognize", "objective", "search"):
        assert not keys(SMALL, kind) & keys(seen_larger, kind)
    shorter = replace(SMALL, patience=1.5)
    assert not keys(SMALL, "search") & keys(shorter, "search")
    assert keys(SMALL, "recognize") == keys(shorter, "recognize")
    assert len({one.fingerprint for one in (SMALL, otherwise_taught, seen_larger, shorter)}) == 4


def test_a_plan_for_a_world_of_one_s_own_compares_the_best_two_after_one_drive() -> None:
    own = in_world("town.json", 1.5)
    (world,) = own.worlds
    assert world.title == "town"
    assert {(trial.controller, trial.drives) for trial in world.trials} == {("smal", 1), ("teach-and-repeat", 1)}
    assert world.criteria == (Criterion(3.0, 25.0),)
    assert {unit.kind for unit in units(own)} == {"teach", "learn", "search"}


@pytest.mark.parametrize(
    ("make", "problem"),
    [
        (lambda: WorldPlan("yard", CRITERIA, recognized=("foggy",)), "unknown degradation 'foggy'"),
        (lambda: Trial("smal", 1, 1, variation="night"), "unknown variation 'night'"),
        (lambda: Trial("best", 1, 1), "unknown controller 'best'"),
        (lambda: Trial("smal", 0, 1), "a trial needs at least one drive and one run, got 0 and 1"),
        (
            lambda: WorldPlan("yard", CRITERIA, trials=(Trial("smal", 1, 2), Trial("smal", 1, 3))),
            "stands in the plan twice",
        ),
        (lambda: WorldPlan("yard", CRITERIA, drives=0), "yard: a plan needs at least one drive"),
    ],
)
def test_plans_that_cannot_be(make: Callable[[], object], problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        make()
