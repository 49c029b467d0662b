"""Plans come to units that are all different, in an order in which they can be done, and do what the issue asks."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import pytest

from services.commands.evaluation.plan import FULL, PLANS, QUICK, Criterion, Plan, WorldPlan
from services.commands.evaluation.units import units
from tests.services.commands.evaluation.evaluated import SMALL


@pytest.mark.parametrize("plan", [*PLANS.values(), SMALL], ids=lambda plan: plan.name)
@pytest.mark.parametrize("cloning", [False, True])
def test_every_unit_comes_once_and_after_those_that_it_needs(plan: Plan, cloning: bool) -> None:
    done: set[str] = set()
    for unit in units(plan, cloning=cloning):
        assert unit.key not in done
        assert set(unit.needs) <= done
        assert unit.seconds > 0.0
        done.add(unit.key)


def test_the_full_plan_is_that_of_the_paper_and_more() -> None:
    searches = [unit for unit in units(FULL, cloning=True) if unit.kind == "search"]
    each = Counter((unit.world, unit["controller"], unit["length"], unit["degradation"]) for unit in searches)
    for world in ("indoor", "campus"):
        for degradation in ("clean", "poor"):
            for scheme in ("paper", "overlapping", "smal"):
                for length in (1, 2, 5, 10, 20, 40):
                    assert each[world, scheme, length, degradation] >= 10
            for peer in ("nearest-1", "nearest-5", "seqslam", "cloning"):
                assert each[world, peer, 5, degradation] >= 10
    assert not FULL.omitted


def test_the_quick_plan_says_what_it_leaves_out_and_is_much_shorter() -> None:
    assert QUICK.omitted
    quick, full = (sum(unit.seconds for unit in units(plan, cloning=True)) for plan in (QUICK, FULL))
    assert 10 * quick < full


def test_without_torch_nobody_clones() -> None:
    controllers = {unit["controller"] for unit in units(SMALL, cloning=False) if unit.kind == "search"}
    assert "cloning" not in controllers
    assert "nearest-5" in controllers


def test_keys_change_with_what_was_taught_and_with_when_searches_time_out() -> None:
    def keys(plan: Plan, kind: str) -> set[str]:
        return {unit.key for unit in units(plan, cloning=False) if unit.kind == kind}

    (world,) = SMALL.worlds
    otherwise_taught = replace(SMALL, worlds=(replace(world, recoveries=4),))
    seen_larger = replace(SMALL, camera=(128, 96))
    for other in (otherwise_taught, seen_larger):
        for kind in ("learn", "recognise", "objective", "search"):
            assert not keys(SMALL, kind) & keys(other, kind)
    shorter = replace(SMALL, max_ticks=100)
    assert not keys(SMALL, "search") & keys(shorter, "search")
    assert keys(SMALL, "recognise") == keys(shorter, "recognise")
    assert len({plan.fingerprint for plan in (SMALL, otherwise_taught, seen_larger, shorter)}) == 4


def test_plans_that_cannot_be() -> None:
    criteria = (Criterion(1.0, 25.0),)
    with pytest.raises(ValueError, match="unknown degradation 'foggy'"):
        WorldPlan("yard", 1, 0, criteria, 1, (1,), ("foggy",))
    with pytest.raises(ValueError, match="unknown scheme 'best'"):
        WorldPlan("yard", 1, 0, criteria, 1, (1,), ("clean",), searched={"best": ("clean",)})
    with pytest.raises(ValueError, match="yard: a plan needs at least one drive"):
        WorldPlan("yard", 0, 5, criteria, 1, (1,), ("clean",))
