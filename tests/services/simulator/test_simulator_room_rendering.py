"""Pixels of the room: the victim, the marker from above, and never anything black where the room has no surface."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
import shapely

from services.simulator.scene.rendering import NOTHING, ROBOT, SceneCamera
from services.simulator.sensors.camera import CameraSettings
from services.simulator.simulation import Simulation
from services.simulator.world.place import Pose
from services.simulator.world.route import plan_route
from tests.services.simulator.simulator_rooms import indoor

pytestmark = pytest.mark.rendering

INDOOR = indoor()
ROUTE = shapely.LineString(plan_route(INDOOR, (INDOOR.start.x, INDOOR.start.y)))


@pytest.fixture(scope="module")
def camera() -> SceneCamera:
    return SceneCamera(INDOOR, CameraSettings(160, 120))


def along(fraction: float, turned: float = 0.0) -> Pose:
    """Return a pose on the route that looks along it."""
    (x, y), (ahead_x, ahead_y) = (
        shapely.get_coordinates(ROUTE.interpolate(at))[0]
        for at in (fraction * ROUTE.length, fraction * ROUTE.length + 0.05)
    )  # fmt: skip
    return Pose(float(x), float(y), math.atan2(ahead_y - y, ahead_x - x) + turned)


def facing_the_victim(away_m: float, turned: float = 0.0) -> Pose:
    victim = INDOOR.victim
    direction = victim.heading + turned
    return Pose(
        victim.x + away_m * math.cos(direction), victim.y + away_m * math.sin(direction), direction + math.pi
    )  # fmt: skip


def test_the_victim_is_seen_near_and_facing_and_not_otherwise(camera: SceneCamera) -> None:
    near = facing_the_victim(1.2)
    assert camera.victim_pixels(near) > 0.02
    assert camera.victim_pixels(facing_the_victim(0.8)) > camera.victim_pixels(near)
    assert camera.victim_pixels(Pose(near.x, near.y, near.heading + math.pi)) == 0


def test_no_start_sees_the_victim(camera: SceneCamera) -> None:
    simulation = Simulation(INDOOR, camera)
    for seed in range(10):
        start = simulation.reset(seed, "run")
        for turn in np.linspace(0, 2 * math.pi, 6, endpoint=False):
            assert camera.victim_pixels(Pose(start.x, start.y, float(turn))) == 0


def test_the_robot_sees_the_room_everywhere_and_not_itself(camera: SceneCamera) -> None:
    for fraction in np.linspace(0, 0.9, 7):
        for turned in (0.0, 1.6, 3.1, -1.6):
            pose = along(float(fraction), turned)
            image = camera.render(pose)
            assert image.max(axis=2).min() > 8, "no pixel is black"
            assert np.isfinite(camera.depth_m(pose)).all()
            assert not (camera._labels(pose) == ROBOT).any()


def test_places_on_the_route_look_different_from_each_other(camera: SceneCamera) -> None:
    images = np.stack([camera.render(along(float(f))).astype(float) for f in np.linspace(0, 0.95, 8)]).reshape(8, -1)
    images -= images.mean(axis=1, keepdims=True)
    alike = np.corrcoef(images)
    assert alike[~np.eye(8, dtype=bool)].max() < 0.9


@pytest.mark.parametrize("heading", [0.0, 0.7, 2.0, -2.5])
def test_the_marker_is_found_from_above_with_its_number_place_and_direction(
    camera: SceneCamera, heading: float
) -> None:
    mount, tag = INDOOR.place.overhead, INDOOR.robot.tag
    assert mount is not None
    assert tag is not None
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
    for fraction in (0.0, 0.3, 0.55, 0.8, 0.95):
        pose = along(fraction)
        pose = Pose(pose.x, pose.y, heading)
        corners, numbers, _ = detector.detectMarkers(cv2.cvtColor(camera.overhead(pose), cv2.COLOR_RGB2GRAY))
        assert numbers is not None, f"not found at {pose}"
        assert numbers.ravel().tolist() == [tag.number]
        # A pinhole at (x, y, height) that looks down, its image's up to the north: columns east, rows south.
        metres = (corners[0][0] + 0.5 - (mount.width / 2, mount.height / 2)) * (mount.height_m - tag.height_m)
        places = metres / mount.focal_px * (1, -1) + (mount.x, mount.y)
        np.testing.assert_allclose(places.mean(axis=0), (pose.x, pose.y), atol=0.03)
        front = places[:2].mean(axis=0) - places[2:].mean(axis=0)
        assert abs(math.remainder(math.atan2(front[1], front[0]) - heading, math.tau)) < math.radians(6)


def test_the_camera_above_sees_through_the_ceiling_and_the_victim_below(camera: SceneCamera) -> None:
    picture = camera.overhead(INDOOR.start)
    assert picture.shape == (600, 800, 3)
    mount = INDOOR.place.overhead
    assert mount is not None
    scale = mount.focal_px / (mount.height_m - 0.4)
    column, row = 400 + (INDOOR.victim.x - 4.0) * scale, 300 - (INDOOR.victim.y - 3.0) * scale
    patch = picture[int(row) - 12 : int(row) + 12, int(column) - 12 : int(column) + 12].astype(int)
    orange = (patch[..., 0] > 150) & (patch[..., 0] - patch[..., 2] > 80)
    assert orange.sum() >= 5, "the victim's shoulders"
    assert (camera._above.get_picture("Color")[..., 3] != NOTHING).all(), "no gap in the floor"
