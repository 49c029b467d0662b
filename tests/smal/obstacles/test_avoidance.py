"""A robot with a depth camera on a straight taught way: it goes round boxes, comes back, and waits if none leads on."""

import math
from collections.abc import Sequence

import numpy as np
import pytest

from smal.movement import Atom
from smal.obstacles.avoidance import hit_m, turn_round
from smal.obstacles.clearance import Surroundings
from tests.smal.depth_world import MOUNT, MOVEMENTS, Box, depth, moved, touches

END_M, TURN_RAD = 16.0, float(MOVEMENTS[Atom.LEFT, 1])


def drive(boxes: Sequence[Box], ticks: int = 400) -> tuple[np.ndarray, int]:
    """Follow the way, y = 0, and go round boxes; return the poses and how often nothing led round."""
    around, pose, blocked = Surroundings(MOUNT.radius_m), (0.0, 0.0, 0.0), 0
    poses = [pose]
    for _ in range(ticks):
        around.look(pose, depth(boxes, pose), MOUNT)
        x = np.arange(pose[0] + 1.4, min(pose[0] + 7.8, END_M + 1.5), 0.35)
        c, s = math.cos(pose[2]), math.sin(pose[2])
        way = np.stack([x - pose[0], np.full(x.size, -pose[1])], axis=1) @ np.array([[c, -s], [s, c]])
        turn: float | None = math.atan2(way[0, 1], way[0, 0])
        if hit_m(around, way) < math.inf:
            turn = turn_round(around, way, TURN_RAD, float(MOVEMENTS[Atom.FORWARD, 0]))
        if turn is None:
            blocked += 1
            continue
        pose = moved(pose, Atom.FORWARD if abs(turn) < TURN_RAD else Atom.LEFT if turn > 0 else Atom.RIGHT)
        assert not touches(boxes, pose)
        poses.append(pose)
        if pose[0] > END_M:
            break
    return np.array(poses), blocked


@pytest.mark.parametrize(
    "boxes",
    [
        [],
        [(6.0, -0.4, 6.8, 0.4, 0.9)],
        [(6.0, -1.6, 6.3, 0.2, 1.0)],
        [(6.0, -0.9, 10.2, 0.9, 1.5)],
        [(5.0, -0.2, 5.5, 1.5, 1.0), (9.0, -1.5, 9.5, 0.2, 1.0)],
    ],
    ids=["nothing", "a box", "to the left", "a car", "two"],
)
def test_it_goes_round_and_comes_back(boxes: list[Box]) -> None:
    poses, blocked = drive(boxes)
    assert poses[-1, 0] > END_M
    assert blocked == 0
    assert np.abs(poses[:, 1]).max() < 2.4
    assert abs(poses[-1, 1]) < 0.2
    assert len(poses) < 160  # 80 frames straight on


def test_it_waits_where_nothing_leads_round() -> None:
    poses, blocked = drive([(6.0, -8.0, 6.3, 8.0, 1.0)], ticks=200)
    assert blocked > 100
    assert poses[-1, 0] < 6.0
