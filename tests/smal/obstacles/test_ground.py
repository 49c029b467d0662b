"""Without depth: unexpected ground on the taught way slows a robot, then stops it."""

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from smal import Model, Robot, fit
from smal.camera import Camera, Image
from smal.obstacles.ground import Ground, extreme
from tests import corridor

BOX = (214, 120, 40)


def view(pose: corridor.Pose, box_m: float | None = None) -> Image:
    """Return what is seen in the corridor, with a box half a metre wide and high so far along."""
    picture = corridor.view(*pose)
    rows, columns = picture.shape[:2]
    picture[rows // 2 :] = (
        100 + picture[rows // 2 :] // 16
    )  # A floor that looks much the same everywhere.
    if box_m is not None and box_m - pose[0] > 0.3:
        cos = math.cos(pose[2])
        sin = math.sin(pose[2])
        ahead = (box_m - pose[0]) * cos - pose[1] * sin
        left = -pose[1] * cos - (box_m - pose[0]) * sin
        focal = 0.7 * columns / ahead
        middle = columns / 2 - focal * left
        half = focal / 4
        foot = min(rows, round(rows / 2 + focal / 2))
        picture[rows // 2 : foot, max(0, round(middle - half)) : max(0, round(middle + half))] = BOX
    return picture


@cache
def model() -> Model:
    _, atoms, way = corridor.drive()
    return fit(
        [([view(pose) for pose in way], atoms, way)],
        corridor.FEATURES,
        camera=Camera(0.7),
        tick_s=0.5,
    )


def driven(watches: bool, box_m: float | None) -> tuple[Robot, list[tuple[str, float]], float]:
    """Let a robot drive the way, 0.2 m a frame; return it, what it did and how fast, and how far it came."""
    robot = Robot(model(), watches=watches)
    here = (0.0, 0.1, 0.0)
    did = []
    for _ in range(60):  # It may look around once first, for 20 frames.
        robot.step(view(here, box_m), here)
        did.append((robot.decision.kind, robot.decision.motion[0]))
        if robot.done:
            break
        linear, angular = robot.executed = robot.decision.motion
        heading = here[2] + angular * model().mapped.turn_rad
        ahead = linear * corridor.STEP_M
        here = here[0] + ahead * math.cos(heading), here[1] + ahead * math.sin(heading), heading
    return robot, did, here[0]


def test_watching_robot_slows_and_stops_before_a_box() -> None:
    robot, did, came_m = driven(True, 3.0)
    kinds, speeds = zip(*did, strict=True)
    stopped = kinds.index("blocked")
    assert robot.said is None
    assert 1.5 < came_m < 2.5
    assert max(speeds[:stopped]) == 1.0
    assert 0.0 < speeds[stopped - 1] <= 0.5
    assert set(speeds[stopped : stopped + 9]) == {0.0}, "it waits for five seconds at least"
    assert driven(False, 3.0)[0].said == "found", "who does not watch drives into it"


def test_the_taught_way_is_not_strange() -> None:
    robot, did, _ = driven(True, None)
    assert robot.said == "found"
    assert "blocked" not in dict(did)


def test_threshold_is_rarely_exceeded() -> None:
    rng = np.random.default_rng(2)
    threshold = extreme(rng.exponential(0.01, 200).tolist())
    assert 0.01 * math.log(1e3) < threshold < 0.01 * math.log(1e6)
    assert (rng.exponential(0.01, 5000) < threshold).all()


def test_a_file_keeps_the_ground_and_one_without_it_is_read(tmp_path: Path) -> None:
    for ground in (model().ground, None):
        replace(model(), ground=ground).save(tmp_path / "way.smal")
        read = Model.load(tmp_path / "way.smal").ground
        assert (read is None) == (ground is None)
        assert read is None or ground is None or np.array_equal(read.colours, ground.colours)
    with pytest.raises(ValueError, match="has no ground"):
        Robot(Model.load(tmp_path / "way.smal"), watches=True)
    harmed = Ground(np.zeros((3, 5, 3), np.uint8), 0.1)
    with pytest.raises(ValueError, match="other keyframes than the map"):
        replace(model(), ground=harmed)
