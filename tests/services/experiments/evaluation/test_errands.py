"""Errands are what they say: nobody drove them in one piece, or the last that was taught is not what is wanted."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest

from services.experiments.evaluation.errands import TASKS, Taught
from services.experiments.evaluation.plan import ERRANDS, FULL
from services.experiments.evaluation.units import units
from services.simulator.world import load_world
from services.simulator.world.collision import obstacles_of
from services.simulator.world.place import Pose, World
from services.simulator.world.route import plan_route, route_length_m


@pytest.fixture(scope="module")
def terrace() -> World:
    return load_world("terrace")


def way_m(world: World, start: Pose, victim: Pose, via: tuple[tuple[float, float], ...] = ()) -> float:
    """Return the length of the shortest way through some places."""
    places = [(start.x, start.y), *via, (victim.x, victim.y)]
    legs = (plan_route(World(world.place, start, Pose(*to, 0.0)), here) for here, to in pairwise(places))
    return sum(route_length_m(leg) for leg in legs)


def test_every_errand_is_described_and_planned() -> None:
    assert list(TASKS) == list(ERRANDS)
    planned = [unit["errand"] for unit in units(FULL, cloning=False) if unit.kind == "errand"]
    assert planned == list(ERRANDS)


@pytest.mark.parametrize("errand", TASKS)
def test_where_it_begins_and_ends_is_free(terrace: World, errand: str) -> None:
    task = TASKS[errand]
    for one in (*task.taught, Taught(task.start, task.victim, task.goal)):
        assert obstacles_of(terrace.place).is_free(one.start.x, one.start.y, terrace.robot.radius_m + 1.0)
        assert obstacles_of(terrace.place).is_free(one.victim.x, one.victim.y, 0.0)
        assert 50.0 < way_m(terrace, one.start, one.victim, one.via) < 300.0
    assert task.goal in {one.goal for one in task.taught}


def test_the_first_way_that_is_taught_is_much_longer(terrace: World) -> None:
    long, short = (way_m(terrace, one.start, one.victim, one.via) for one in TASKS["shorter way"].taught)
    assert long > 1.3 * short


@pytest.mark.parametrize("errand", ["joined, northwards", "joined, southwards"])
def test_a_joined_way_is_none_that_was_taught(errand: str) -> None:
    task = TASKS[errand]
    assert not any((one.start, one.victim) == (task.start, task.victim) for one in task.taught)
    assert task.start in {one.start for one in task.taught}


def test_the_houses_of_the_street_look_the_same(terrace: World) -> None:
    houses = [one for one in terrace.place.buildings if one.facade.variant == terrace.place.buildings[0].facade.variant]
    assert len(houses) == 20
    assert len({(one.facade, one.height_m, round(one.footprint.area)) for one in houses}) == 1
    along = sorted({round(one.footprint.centroid.x, 1) for one in houses})
    assert all(math.isclose(step, 12.0, abs_tol=0.11) for step in (b - a for a, b in pairwise(along)))
