"""Cameras from narrow to more than a hemisphere teach, drive and watch the ground."""

import math
from functools import cache

import numpy as np
import pytest

from smal.camera import Camera
from smal.model import Model
from smal.obstacles.ground import colours_of, patches
from smal.robot import Robot
from smal.teaching.mapping import fit
from tests.smal.synthetic_world import COLOR, Room, drive

ROOM = Room()
WAY = drive(way=((2.0, 90.0), (1.5, 0.0)))
FIELDS_DEG = [
    60.0,
    pytest.param(120.0, marks=pytest.mark.long),
    pytest.param(160.0, marks=pytest.mark.long),
    180.0,
    220.0,
]


@cache
def learned(field_deg: float) -> Model:
    camera = Camera.of_field(field_deg)
    images = [ROOM.look(pose, camera=camera) for pose in WAY.poses]
    return fit([(images, WAY.atoms, WAY.poses)], COLOR, camera=camera)


@pytest.mark.parametrize("field_deg", FIELDS_DEG)
def test_robot_keeps_its_place_when_the_field_is(field_deg: float) -> None:
    model = learned(field_deg)
    assert model.mapped.taught_scene.camera == Camera.of_field(field_deg)
    robot = Robot(model, watches=True)
    for pose in WAY.poses:
        robot.step(ROOM.look(pose, camera=model.mapped.taught_scene.camera), pose.tolist())
        assert not robot.belief.is_lost
        assert robot.decision.kind != "blocked"
        robot.executed = robot.decision.motion
    key = model.mapped.keyframes[robot.belief.keyframes[0]]
    assert abs(int(key) - len(WAY.poses)) < 10


@pytest.mark.parametrize("field_deg", FIELDS_DEG)
@pytest.mark.parametrize("away", [(1.0, 0.0), (1.2, 0.4)])
def test_ground_is_where_the_camera_shows_it_when_the_field_is(
    field_deg: float, away: tuple[float, float]
) -> None:
    mapped = learned(field_deg).mapped
    scene = mapped.taught_scene
    plain = np.full((60, 80, 3), 90, np.uint8)
    point = np.array([-away[1], scene.height, away[0]])
    angle = math.acos(point[2] / np.linalg.norm(point))
    off = float(scene.camera.radius(angle)) * scene.camera.focal * 80 / np.hypot(*point[:2])
    marked = plain.copy()
    column = round(39.5 + off * point[0])
    row = round(29.5 + off * point[1])
    marked[row - 2 : row + 3, column - 2 : column + 3] = (200, 30, 30)
    way = np.array(away) * np.linspace(0.0, 2.0, 40)[:, None]
    along, score = patches(marked, colours_of(plain)[None], way, mapped)
    # A patch is seven pixels wide.
    found = math.degrees(math.atan2(scene.height, along[score.argmax()]))
    expected = math.degrees(math.atan2(scene.height, away[0]))
    assert found == pytest.approx(expected, abs=3.5 * field_deg / 80)
