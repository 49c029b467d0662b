"""The planner before obstacles without a way round, and with people."""

import math
from dataclasses import replace
from itertools import groupby

import numpy as np
import pytest

from smal.movement import Atom
from smal.obstacles.clearance import Surroundings
from smal.planning import Decision, Planner
from smal.planning.config import PLANNER_CONFIG
from smal.sought.witness import Glimpse
from tests.smal.depth_world import MOUNT, Box, depth
from tests.smal.test_planning import belief, map_of

HERE = 10  # A metre along the way, which is where the robot stands.
WALL: Box = (2.0, -9.0, 2.3, 9.0, 1.0)


def looks(*views: list[Box]) -> Surroundings:
    """Come from two metres back, see nothing but the first view, and then look at each."""
    made = Surroundings(MOUNT.radius_m)
    for x in np.arange(-2.0, 0.0, 0.2):
        made.observe((x, 0.0, 0.0), depth(views[0], (x, 0.0, 0.0)), MOUNT)
    for boxes in views:
        made.observe((0.0, 0.0, 0.0), depth(boxes, (0.0, 0.0, 0.0)), MOUNT)
    return made


def waits(planner: Planner, ticks: int) -> list[Decision]:
    """Stand before a wall for so many ticks, and turn as is decided, until it is decided to drive."""
    made = Surroundings(MOUNT.radius_m)
    heading = 0.0
    decisions = []
    for _ in range(ticks):
        pose = (0.0, 0.0, heading)
        made.observe(pose, depth([WALL], pose), MOUNT)
        decisions.append(
            planner.decide(belief((HERE, 0.0, 0.0, math.degrees(heading))), around=made)
        )
        if decisions[-1].motion[0] > 0.0:
            break
        heading += math.radians(4.5) * decisions[-1].motion[1]
    return decisions


def test_waiting_robot_looks_around_once() -> None:
    decisions = waits(Planner(map_of(16.0)), ticks=400)
    assert len(decisions) == 400
    kinds = [(kind, len(list(same))) for kind, same in groupby(one.kind for one in decisions)]
    assert [kind for kind, _ in kinds] == [
        "follow",
        "blocked",
        "look_around",
        "blocked",
    ]  # it turns before it waits
    assert kinds[1][1] == pytest.approx(2.0 * PLANNER_CONFIG.waits_s / 0.1, abs=1)


def test_waiting_robot_takes_another_way_and_later_the_first() -> None:
    """The second drive leads away to the left where the robot stands, and takes longer."""
    other = 161
    planner = Planner(map_of(16.0, 17.0, stitches=(((HERE, other), (0.0, 0.0, -math.pi / 2.0)),)))
    before = planner.decide(belief((HERE, 0.0, 0.0, 0.0)))
    assert abs(before.heading_rad) < 0.1
    kinds = [one.kind for one in waits(planner, ticks=400)]
    assert (kinds[-1], kinds.count("blocked") > 90, len(kinds) < 400) == ("follow", True, True)
    assert planner.decide(belief((HERE, 0.0, 0.0, 0.0))).heading_rad > 1.0
    for _ in range(round(PLANNER_CONFIG.closed_s / 0.4)):
        later = planner.decide(belief((HERE, 0.0, 0.0, 0.0)), 0.5)
    assert abs(later.heading_rad) < 0.1


@pytest.mark.parametrize(("side", "atom"), [(1.0, Atom.LEFT), (-1.0, Atom.RIGHT)])
def test_waiting_robot_turns_to_a_walker(side: float, atom: Atom) -> None:
    walks = [sorted((side * y_m, side * (y_m + 0.4))) for y_m in np.arange(1.3, 0.45, -0.1)]
    walker: list[list[Box]] = [[WALL, (1.2, low, 1.5, high, 1.7)] for low, high in walks]
    decision = Planner(map_of(16.0)).decide(
        belief((HERE, 0.0, 0.0, 0.0)), around=looks([WALL], *walker)
    )
    assert (decision.kind, decision.motion[0]) == ("blocked", 0.0)
    assert decision.motion[1] == (1.0 if atom is Atom.LEFT else -1.0)


def test_robot_makes_room_for_people_only() -> None:
    x = 0.0
    somebody: Box = (0.7, -0.3, 1.0, 0.3, 1.7)
    planner = Planner(map_of(16.0))
    made = looks([WALL], [WALL, somebody])
    motions = []
    for _ in range(round(1.9 * PLANNER_CONFIG.waits_s / 0.1)):
        pose = (x, 0.0, 0.0)
        made.observe(pose, depth([WALL, somebody], pose), MOUNT)
        motions.append(planner.decide(belief((HERE, x, 0.0, 0.0)), around=made).motion)
        x += 0.04 * motions[-1][0]
    assert (
        motions[: round(PLANNER_CONFIG.waits_s / 0.1)].count((0.0, 0.0))
        == PLANNER_CONFIG.waits_s / 0.1
    )
    assert -1.0 < x < -0.2
    assert motions[-1] == (0.0, 0.0)
    assert not [one for one in waits(Planner(map_of(16.0)), ticks=90) if one.motion[0] < 0.0]


@pytest.mark.parametrize("robot", ["turns on the spot", "car"])
def test_new_obstacle_is_not_the_target(robot: str) -> None:
    thing: list[Box] = [(2.0, -0.3, 2.4, 0.3, 1.7)]
    end = belief((160, 0.0, 0.0, 0.0))
    taught = map_of(16.0)
    if robot == "car":
        taught = replace(
            taught,
            movements=taught.movements + np.array([0.05, 0.0]) * (taught.movements[:, 1:] != 0.0),
        )
    for before, said in (([], None), (thing, "found")):
        planner = Planner(taught)
        made = looks(*[before] * 4, *[thing] * 3)
        for _ in range(100):
            planner.decide(end, seen=Glimpse(0.999, 1.1, 0.0), around=made)
        assert planner.said == said


def test_robot_waits_when_a_person_hides_the_target() -> None:
    planner = Planner(map_of(16.0))
    person: list[Box] = [(1.2, -0.3, 1.6, 0.3, 1.7)]
    end = belief((160, 0.0, 0.0, 0.0))
    hidden = looks([], [], [], [], *[person] * 3)
    waits = [planner.decide(end, seen=Glimpse(0.1, 0.0), around=hidden) for _ in range(40)]
    assert {decision.motion for decision in waits[1:]} == {(0.0, 0.0)}
    assert planner.said is None
    planner.decide(end, 0.5, seen=Glimpse(0.99, 1.1, 0.0), around=looks([]))
    planner.decide(end, 0.5, seen=Glimpse(0.99, 1.1, 0.0), around=looks([]))
    assert planner.said == "found"


def test_search_ends_when_a_thing_stands_before_the_target() -> None:
    planner = Planner(map_of(16.0))
    made = looks([(0.5, -0.4, 0.8, 0.4, 1.7)])
    assert made.free_m(ahead=True) == 0.0
    end = belief((160, 0.0, 0.0, 0.0))
    decisions = [
        planner.decide(end, seen=Glimpse(0.999, 0.3, 0.0), around=made) for _ in range(150)
    ]
    assert (decisions[0].kind, decisions[-1].kind, planner.said) == ("blocked", "goal", "not_here")


def test_robot_backs_off_then_looks_around_when_its_wheels_stand() -> None:
    planner = Planner(map_of(16.0))
    made = looks([])
    x = 0.0
    moved = 0.0
    decisions = []
    for _ in range(50):
        made.move((x, 0.0, 0.0))
        here = replace(belief((HERE, x, 0.0, 0.0)), moved=moved)
        decisions.append(planner.decide(here, around=made))
        moved = 0.02 * min(decisions[-1].motion[0], 0.0)
        x += moved
    kinds = [kind for kind, _ in groupby(decision.kind for decision in decisions)]
    assert kinds == ["follow", "blocked", "follow", "blocked", "look_around"]
    assert -1.0 < x < -0.1


def test_robot_looks_around_when_its_wheels_stand_without_depth() -> None:
    planner = Planner(map_of(16.0))
    stands = replace(belief((HERE, 0.0, 0.0, 0.0)), moved=0.0)
    motions = [planner.decide(stands).motion for _ in range(20)]
    assert sum(linear > 0.0 for linear, _ in motions) == pytest.approx(10, abs=1)
    assert motions[-1][0] == 0.0


def test_robot_drives_on_when_its_wheels_turn() -> None:
    planner = Planner(map_of(16.0))
    made = looks([])
    for x in np.arange(0.0, 4.0, 0.1):
        made.observe((x, 0.0, 0.0), depth([], (x, 0.0, 0.0)), MOUNT)
        here = replace(belief((HERE, x, 0.0, 0.0)), moved=0.1)
        assert planner.decide(here, around=made).motion[0] > 0.0
