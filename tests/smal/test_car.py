"""A car, which cannot turn on the spot: one lap that is all one bend is learned, recognized and driven again."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from smal.features import Centering, extract
from smal.filter import Filter
from smal.map import VisualMap
from smal.movement import STILL, Atom, Motion, Movement, dead_reckoning
from smal.planning import Planner
from tests.smal.synthetic_world import COLOR, SCENE, TICK, Drive, Pose, Room, from_beside, taught

ROOM = Room()
#: A tick ahead, and the bend: 20 cm, and a circle of 2 m.
STEP = 0.2
RADIUS = 2.0
TURN = STEP / RADIUS
CAR = np.array([[0.0, 0.0], [STEP, 0.0], [-STEP, 0.0], [STEP, TURN], [STEP, -TURN]])
START = (6.0, 6.0 - RADIUS, 0.0)


def lap() -> Drive:
    """Drive once round to the left about the middle of the room."""
    atoms = np.full(round(math.tau / TURN) + 1, Atom.LEFT, dtype=np.int8)
    way = dead_reckoning(atoms, CAR)
    return Drive(way + np.array(START), atoms)


@cache
def learned(odometry: bool) -> tuple[VisualMap, Centering]:
    """Learn one lap; without odometry a tick ahead is the unit."""
    unit = 1.0 if odometry else STEP
    scene = replace(SCENE, height=SCENE.height / unit, distance=SCENE.distance / unit)
    ahead = np.ones(len(lap().atoms), dtype=np.float32)
    return taught(ROOM, lap(), odometry=odometry, scene=scene, ahead=ahead)


def moved(pose: Pose, motion: Motion) -> Pose:
    ahead = STEP * motion[0]
    turn = TURN * motion[1]
    return np.array(
        from_beside(pose, ahead * math.cos(turn / 2.0), ahead * math.sin(turn / 2.0), turn)
    )


@pytest.mark.parametrize("odometry", [True, False])
def test_lap_is_learned_as_a_circle(odometry: bool) -> None:
    found, _ = learned(odometry)
    unit = 1.0 if odometry else STEP
    table = found.movements * np.array([unit, 1.0])
    # How far an atom turns is measured on the views, with the usual field of view for the camera's.
    np.testing.assert_allclose(table, CAR, rtol=1e-6 if odometry else 0.2, atol=1e-9)
    assert found.speed * unit == pytest.approx(STEP / TICK)
    across = np.hypot(*(found.poses[len(found.poses) // 2] - found.poses[0])[:2])
    assert across * unit == pytest.approx(2.0 * RADIUS, rel=0.01 if odometry else 0.25)
    assert 0.3 < found.correlation_length * unit < 1.2
    assert found.likelihood.of(np.array([6.0])) > 0.5


@pytest.mark.parametrize("odometry", [True, False])
def test_car_drives_another_lap_by_the_same_bend(odometry: bool) -> None:
    found, centering = learned(odometry)
    follower = Filter(found, centering)
    planner = Planner(found)
    pose = np.array([START[0], START[1] - 0.1, 0.1])
    movement = STILL
    made = []
    for frame in range(2 * len(found.poses)):
        belief = follower.observe(extract(ROOM.look(pose), COLOR), movement)
        motion = planner.decide(belief).motion
        if planner.said:
            break
        assert belief.lost < 0.5
        off = abs(int(found.keyframes[belief.summary(1).keyframes[0]]) - frame)
        # Where a lap ends it begins again.
        assert min(off, len(found.poses) - off) <= 3
        after = moved(pose, motion)
        usual = Movement(motion[0] * found.speed * found.tick_s, motion[1] * found.turn_rad)
        movement = Movement.between(pose, after) if odometry else usual
        pose = after
        assert abs(math.hypot(pose[0] - 6.0, pose[1] - 6.0) - RADIUS) < 0.4
        made.append(motion)
    assert planner.said
    assert len(made) == pytest.approx(len(found.poses), abs=4)
    assert sum(angular > 0.5 for _, angular in made) > 0.9 * len(made)


def test_turning_implies_moving_unless_the_wheels_deny_it() -> None:
    part = Drive(lap().poses[:24], lap().atoms[:24])
    found, _ = taught(ROOM, part, odometry=False, scene=SCENE)
    assert found.movements[Atom.LEFT, 0] == 1.0
    spinning = Drive(part.poses * (0.0, 0.0, 1.0), part.atoms)
    with pytest.raises(ValueError, match="does not move"):
        taught(ROOM, spinning, scene=SCENE)
