"""Errands are what they say: nobody drove them in one piece, or the last that was taught is not what is wanted."""

from __future__ import annotations

from itertools import pairwise

import pytest

from services.experiments.evaluation.multi_drive_tasks import TASKS, Taught
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
