"""Pixels: repeatable to the bit, the victim where it should be and nowhere else, the robot never in its own way."""

from __future__ import annotations

import math
from functools import cache

import cv2
import numpy as np
import pytest
import shapely

from services.simulator.camera import CameraSettings
from services.simulator.scene.rendering import ROBOT, SceneCamera
from services.simulator.sensors import LEVEL
from services.simulator.simulation import Simulation
from services.simulator.world import load_world
from services.simulator.world.place import Pose
from services.simulator.world.route import plan_route
from tests.services.simulator.simulator_driving import drive_to

pytestmark = pytest.mark.rendering

YARD, INDOOR = (load_world(name) for name in ("yard", "indoor"))
both = pytest.mark.parametrize("name", ["yard", "indoor"])


@cache
def camera_in(name: str) -> SceneCamera:
    return SceneCamera(load_world(name), CameraSettings(160, 120))


def facing_the_victim(name: str, away_m: float) -> Pose:
    """Return a pose that looks at the victim, on the last leg of the route or, indoors, before its face."""
    victim = load_world(name).victim
    corner = plan_route(YARD, (YARD.start.x, YARD.start.y))[-2]
    looks = victim.heading + math.pi if name == "indoor" else math.atan2(victim.y - corner[1], victim.x - corner[0])
    return Pose(victim.x - away_m * math.cos(looks), victim.y - away_m * math.sin(looks), looks)


@both
def test_an_image_has_the_size_asked_for_and_something_in_it_and_repeats_to_the_bit(name: str) -> None:
    """In another order as well, so that nothing is left over from the frame before; indoors nothing is black."""
    camera, other, start = (
        camera_in(name),
        SceneCamera(load_world(name), CameraSettings(160, 120)),
        load_world(name).start,
    )
    poses = [start, facing_the_victim(name, 0.8), *(Pose(start.x, start.y, turn) for turn in (-3.0, -1.5, 0.0, 1.5))]
    for pose in (*poses, *reversed(poses)):
        image = camera.render(pose)
        assert (image.shape, image.dtype) == ((120, 160, 3), np.uint8)
        assert image.std() > 5
        assert name == "yard" or image.max(axis=2).min() > 8
        assert not (camera._labels(pose, LEVEL) == ROBOT).any(), "the robot does not see itself"
        np.testing.assert_array_equal(image, other.render(pose))


@pytest.mark.parametrize(
    ("name", "near_m", "nearer_m", "share"), [("yard", 4.5, 3.0, 0.002), ("indoor", 1.2, 0.8, 0.02)]
)
def test_the_victim_is_seen_near_and_facing_and_from_no_start(
    name: str, near_m: float, nearer_m: float, share: float
) -> None:
    camera, near = camera_in(name), facing_the_victim(name, near_m)
    assert camera.victim_pixels(near) > share
    assert camera.victim_pixels(facing_the_victim(name, nearer_m)) > camera.victim_pixels(near)
    assert camera.victim_pixels(Pose(near.x, near.y, near.heading + math.pi)) == 0
    simulation = Simulation(load_world(name), camera)
    for seed in range(10):
        start = simulation.reset(seed, "run")
        for turn in (0.0, *(np.linspace(1.0, 6.0, 5) if name == "indoor" else ())):
            assert camera.victim_pixels(Pose(start.x, start.y, start.heading + float(turn))) == 0


def test_the_simulation_finds_the_victim_by_its_own_eyes() -> None:
    simulation = Simulation(YARD, camera_in("yard"))
    simulation.reset(0, "run")
    assert not simulation.look().victim_found
    for x, y in simulation.route()[1:]:
        drive_to(simulation, x, y, lambda: simulation.look().victim_found)
    assert simulation.look().victim_found
    assert not simulation.collided


@pytest.mark.parametrize("heading", [0.0, 0.7, 2.0, -2.5])
def test_the_marker_is_found_from_above_with_its_number_place_and_direction(heading: float) -> None:
    mount, tag = INDOOR.place.overhead, INDOOR.robot.tag
    assert mount is not None
    assert tag is not None
    camera = camera_in("indoor")
    route = shapely.LineString(plan_route(INDOOR, (INDOOR.start.x, INDOOR.start.y)))
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
    for fraction in (0.0, 0.3, 0.55, 0.8, 0.95):
        place = route.interpolate(fraction, normalized=True)
        pose = Pose(place.x, place.y, heading)
        corners, numbers, _ = detector.detectMarkers(cv2.cvtColor(camera.overhead(pose), cv2.COLOR_RGB2GRAY))
        assert numbers is not None, f"not found at {pose}"
        assert numbers.ravel().tolist() == [tag.number]
        # A pinhole at (x, y, height) that looks down, its image's up to the north: columns east, rows south.
        metres = (corners[0][0] + 0.5 - (mount.width_px / 2, mount.height_px / 2)) * (mount.height_m - tag.height_m)
        places = metres / mount.focal_px * (1, -1) + (mount.x_m, mount.y_m)
        np.testing.assert_allclose(places.mean(axis=0), (pose.x, pose.y), atol=0.03)
        front = places[:2].mean(axis=0) - places[2:].mean(axis=0)
        assert abs(math.remainder(math.atan2(front[1], front[0]) - heading, math.tau)) < math.radians(6)
