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
from smal.target.detector import TargetEstimate
from tests.smal.depth_world import MOUNT, Box, depth, touches
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
            planner.decide(end, target=TargetEstimate(0.999, 1.1, 0.0), around=made)
        assert planner.said == said


def test_robot_waits_when_a_person_hides_the_target() -> None:
    planner = Planner(map_of(16.0))
    person: list[Box] = [(1.2, -0.3, 1.6, 0.3, 1.7)]
    end = belief((160, 0.0, 0.0, 0.0))
    hidden = looks([], [], [], [], *[person] * 3)
    waits = [planner.decide(end, target=TargetEstimate(0.1, 0.0), around=hidden) for _ in range(40)]
    assert {decision.motion for decision in waits[1:]} == {(0.0, 0.0)}
    assert planner.said is None
    planner.decide(end, 0.5, target=TargetEstimate(0.99, 1.1, 0.0), around=looks([]))
    planner.decide(end, 0.5, target=TargetEstimate(0.99, 1.1, 0.0), around=looks([]))
    assert planner.said == "found"


@pytest.mark.parametrize(("near", "said"), [(0.3, "not_here"), (0.59, "found")])
def test_search_ends_when_a_thing_stands_before_the_target(near: float, said: str) -> None:
    planner = Planner(map_of(16.0))
    made = looks([(0.5, -0.4, 0.8, 0.4, 1.7)])
    assert made.free_m(ahead=True) == 0.0
    end = belief((160, 0.0, 0.0, 0.0))
    decisions = [
        planner.decide(end, target=TargetEstimate(0.999, near, 0.0), around=made)
        for _ in range(150)
    ]
    assert (decisions[0].kind, decisions[-1].kind, planner.said) == ("blocked", "goal", said)


@pytest.mark.parametrize(("near", "said"), [(0.59, "found"), (0.3, None)])
def test_robot_stopped_before_the_target_has_found_it(near: float, said: str | None) -> None:
    planner = Planner(map_of(16.0))
    end = belief((160, 0.0, 0.0, 0.0))
    target = TargetEstimate(0.999, near, 0.0)
    heard = []
    for _ in range(13):
        planner.decide(end, target=target, around=looks([]), held_back=True)
        heard.append(planner.said)
    assert (heard[8], heard[-1]) == (None, said)


def test_robot_backs_off_when_its_guard_stops_it() -> None:
    planner = Planner(map_of(16.0))
    made = looks([])
    here = belief((HERE, 0.0, 0.0, 0.0))
    decisions = [planner.decide(here, around=made, held_back=True) for _ in range(14)]
    assert decisions[0].motion[0] > 0.0
    assert (decisions[-1].kind, decisions[-1].motion) == ("blocked", (-1.0, 0.0))
    assert made.free_m(ahead=True) == 0.0


def drives(boxes: list[Box], ticks: int = 600) -> tuple[float, int, list[str]]:
    """Drive along the way, y = 0, among boxes that no camera shows.

    Returns the way ahead, the ticks for which the wheels stood against a box, and the kinds of
    decisions in turn.
    """
    planner = Planner(map_of(16.0))
    made = Surroundings(MOUNT.radius_m)
    pose = (0.0, 0.0, 0.0)
    ahead = 0.0
    touched = 0
    kinds = []
    for _ in range(ticks):
        made.move(pose)
        x, y, heading = pose
        place = belief((HERE, x, y, math.degrees(heading)))
        decision = planner.decide(replace(place, moved=ahead), around=made)
        kinds.append(decision.kind)
        linear, angular = decision.motion
        ahead = 0.1 * linear
        there = (x + ahead * math.cos(heading), y + ahead * math.sin(heading))
        if touches(boxes, there):
            ahead = 0.0
            there = (x, y)
            touched += 1
        pose = (*there, heading + math.radians(4.5) * angular)
        if x > 6.0:
            break
    return pose[0], touched, [kind for kind, _ in groupby(kinds)]


@pytest.mark.parametrize(
    "boxes",
    [
        [(2.0, -0.2, 2.4, 0.2, 1.0)],
        [(2.0, -0.7, 2.4, -0.25, 1.0)],
        [(2.0, 0.3, 2.4, 4.0, 1.0)],
        [(2.0, -0.8, 2.4, 0.8, 1.0)],
        [(2.0, -4.0, 2.4, -0.2, 1.0), (2.0, 1.0, 2.4, 5.0, 1.0)],
    ],
    ids=["ahead", "to the right", "a wall to the left", "wide", "a door"],
)
def test_robot_goes_round_what_it_touches(boxes: list[Box]) -> None:
    x, touched, _ = drives(boxes)
    assert x > 6.0
    assert 0 < touched < 70


@pytest.mark.long
def test_robot_looks_around_when_it_touches_things_again() -> None:
    x, _, kinds = drives([(2.0, -9.0, 2.4, 9.0, 1.0)])
    assert x < 2.0
    assert kinds[:4] == ["follow", "blocked", "follow", "blocked"]
    assert "look_around" in kinds


def test_robot_tries_again_when_it_has_touched_all_around() -> None:
    planner = Planner(map_of(16.0))
    made = Surroundings(MOUNT.radius_m)
    for heading in np.arange(0.0, math.tau, 0.2):
        made.move((0.0, 0.0, heading))
        made.touch()
    made.move((0.0, 0.0, 0.0))
    here = replace(belief((HERE, 0.0, 0.0, 0.0)), moved=0.0)
    kinds = [planner.decide(here, around=made).kind for _ in range(70)]
    assert kinds[10:45] == ["blocked"] * 35
    assert kinds[-1] == "follow"


def test_touched_obstacle_stays_until_the_robot_stands_there() -> None:
    made = Surroundings(MOUNT.radius_m)
    made.move((1.0, 2.0, 0.5))
    assert made.free_m(ahead=True) == pytest.approx(made.reach_m, abs=0.2)
    made.touch()
    assert made.free_m(ahead=True) == 0.0
    assert made.free_m(ahead=False) == 0.0  # Nothing shows what is behind.
    made.observe((1.0, 2.0, 0.5), depth([], (1.0, 2.0, 0.5)), MOUNT)
    assert made.free_m(ahead=True) == 0.0  # A camera that has not shown it does not deny it.
    made.move((1.4, 2.2, 0.5))
    made.move((1.0, 2.0, 0.5))
    assert made.free_m(ahead=True) > 1.0  # The robot stood there meanwhile.


def test_robot_drives_on_when_its_wheels_turn() -> None:
    planner = Planner(map_of(16.0))
    made = looks([])
    for x in np.arange(0.0, 4.0, 0.1):
        made.observe((x, 0.0, 0.0), depth([], (x, 0.0, 0.0)), MOUNT)
        here = replace(belief((HERE, x, 0.0, 0.0)), moved=0.1)
        assert planner.decide(here, around=made).motion[0] > 0.0
