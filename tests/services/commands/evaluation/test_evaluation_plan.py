"""Plans come to units that are all different, in an order in which they can be done, and do what the issue asks."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import pytest

from services.commands.evaluation import plan
from services.commands.evaluation.plan import FULL, PLANS, QUICK, Criterion, Plan, WorldPlan
from services.commands.evaluation.units import units
from tests.services.commands.evaluation.evaluated import SMALL


@pytest.mark.parametrize("chosen", [*PLANS.values(), SMALL], ids=lambda one: one.name)
@pytest.mark.parametrize("cloning", [False, True])
def test_every_unit_comes_once_and_after_those_that_it_needs(chosen: Plan, cloning: bool) -> None:
    done: set[str] = set()
    for unit in units(chosen, cloning=cloning):
        assert unit.key not in done
        assert set(unit.needs) <= done
        assert unit.seconds > 0.0
        done.add(unit.key)


def test_the_full_plan_is_that_of_the_paper_and_more() -> None:
    searches = [unit for unit in units(FULL, cloning=True) if unit.kind == "search"]
    each = Counter((unit.world, unit["controller"], unit["length"], unit["degradation"]) for unit in searches)
    for world in ("indoor", "campus"):
        for degradation in ("clean", "poor"):
            for length in (1, 5, 10, 20, 40):
                assert each[world, "paper", length, degradation] >= 10
            for peer in ("smal", "nearest-1", "nearest-5", "seqslam", "cloning"):
                assert each[world, peer, 5, degradation] >= 10
    assert not FULL.omitted


def test_the_quick_plan_says_what_it_leaves_out_and_is_much_shorter() -> None:
    assert QUICK.omitted
    quick, full = (sum(unit.seconds for unit in units(one, cloning=True)) for one in (QUICK, FULL))
    assert 10 * quick < full


def test_what_all_plans_have_in_common_is_part_of_their_fingerprint(monkeypatch: pytest.MonkeyPatch) -> None:
    before = FULL.fingerprint
    for name, other in (("JUDGED_TICKS", 1), ("PEERS", ("nearest-1",)), ("PEER_RECOGNISERS", ())):
        with monkeypatch.context() as patch:
            patch.setattr(plan, name, other)
            assert FULL.fingerprint != before, name
    monkeypatch.setitem(plan.SCHEMES, "smal", "another")
    assert FULL.fingerprint != before


def test_who_works_with_drives_needs_them() -> None:
    for unit in units(FULL, cloning=True):
        if unit.kind in {"recognise", "search", "objective"}:
            kinds = {need.split("/")[0] for need in unit.needs}
            assert {"teach", "learn"} <= kinds


def test_without_torch_nobody_clones() -> None:
    controllers = {unit["controller"] for unit in units(SMALL, cloning=False) if unit.kind == "search"}
    assert "cloning" not in controllers
    assert "nearest-5" in controllers


def test_keys_change_with_what_was_taught_and_with_when_searches_time_out() -> None:
    def keys(one: Plan, kind: str) -> set[str]:
        return {unit.key for unit in units(one, cloning=False) if unit.kind == kind}

    (world,) = SMALL.worlds
    otherwise_taught = replace(SMALL, worlds=(replace(world, recoveries=4),))
    seen_larger = replace(SMALL, camera=(128, 96))
    for other in (otherwise_taught, seen_larger):
        for kind in ("learn", "recognise", "objective", "search"):
            assert not keys(SMALL, kind) & keys(other, kind)
    shorter = replace(SMALL, max_ticks=100)
    assert not keys(SMALL, "search") & keys(shorter, "search")
    assert keys(SMALL, "recognise") == keys(shorter, "recognise")
    assert len({one.fingerprint for one in (SMALL, otherwise_taught, seen_larger, shorter)}) == 4


def test_plans_that_cannot_be() -> None:
    criteria = (Criterion(1.0, 25.0),)
    with pytest.raises(ValueError, match="unknown degradation 'foggy'"):
        WorldPlan("yard", 1, 0, criteria, 1, (1,), ("foggy",))
    with pytest.raises(ValueError, match="unknown scheme 'best'"):
        WorldPlan("yard", 1, 0, criteria, 1, (1,), ("clean",), searched={"best": ("clean",)})
    with pytest.raises(ValueError, match="yard: a plan needs at least one drive"):
        WorldPlan("yard", 0, 5, criteria, 1, (1,), ("clean",))
