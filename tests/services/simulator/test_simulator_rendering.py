"""Pixels: repeatable to the bit, the victim where it should be and nowhere else, the robot never in its own way."""

from __future__ import annotations

import math

import numpy as np
import pytest

from services.simulator.scene.rendering import ROBOT, SceneCamera
from services.simulator.sensors.camera import CameraSettings
from services.simulator.simulation import Simulation
from services.simulator.world import load_world
from services.simulator.world.place import Pose
from services.simulator.world.route import plan_route
from tests.services.simulator.simulator_driving import drive_to

pytestmark = pytest.mark.rendering

YARD = load_world("yard")
SMALL = CameraSettings(160, 120)


@pytest.fixture(scope="module")
def camera() -> SceneCamera:
    return SceneCamera(YARD, SMALL)


def facing_the_victim(away_m: float) -> Pose:
    """Return a pose on the last leg of the route, looking at the victim."""
    corner, victim = plan_route(YARD, (YARD.start.x, YARD.start.y))[-2:]
    direction = math.atan2(*(victim - corner)[::-1])
    return Pose(victim[0] - away_m * math.cos(direction), victim[1] - away_m * math.sin(direction), direction)


def test_an_image_has_the_size_asked_for_and_something_in_it(camera: SceneCamera) -> None:
    image = camera.render(YARD.start)
    assert (image.shape, image.dtype) == ((120, 160, 3), np.uint8)
    sky, ground = image[:20].reshape(-1, 3).mean(axis=0), image[-20:].reshape(-1, 3).mean(axis=0)
    assert image.std() > 25
    assert not np.allclose(sky, ground, atol=20)
    assert image.min(axis=2).max() < 255, "nothing is burnt out"


def test_a_second_camera_sees_the_same_to_the_bit(camera: SceneCamera) -> None:
    other = SceneCamera(load_world("yard"), SMALL)
    poses = [YARD.start, facing_the_victim(4.0), Pose(YARD.start.x, YARD.start.y + 3, 2.0)]
    for pose in poses:
        np.testing.assert_array_equal(camera.render(pose), other.render(pose))
    # And in another order, so that nothing is left over from the frame before.
    for pose in reversed(poses):
        np.testing.assert_array_equal(camera.render(pose), other.render(pose))


def test_the_victim_is_seen_near_and_facing_and_not_otherwise(camera: SceneCamera) -> None:
    near = facing_the_victim(4.5)
    assert camera.victim_pixels(near) > 0.002
    assert camera.victim_pixels(facing_the_victim(3.0)) > camera.victim_pixels(near)
    assert camera.victim_pixels(Pose(near.x, near.y, near.heading + math.pi)) == 0


def test_no_start_sees_the_victim(camera: SceneCamera) -> None:
    simulation = Simulation(YARD, camera)
    for seed in range(10):
        assert camera.victim_pixels(simulation.reset(seed, "run")) == 0


def test_the_simulation_finds_the_victim_by_its_own_eyes(camera: SceneCamera) -> None:
    simulation = Simulation(YARD, camera)
    simulation.reset(0, "run")
    assert not simulation.look().victim_found
    for x, y in simulation.route()[1:]:
        drive_to(simulation, x, y, lambda: simulation.look().victim_found)
    assert simulation.look().victim_found
    assert not simulation.collided


def test_the_robot_does_not_see_itself(camera: SceneCamera) -> None:
    for heading in np.linspace(-3, 3, 7):
        assert not (camera._labels(Pose(YARD.start.x, YARD.start.y, float(heading))) == ROBOT).any()


def test_supersampling_comes_closer_to_the_true_image() -> None:
    plain, better, best = (
        SceneCamera(YARD, CameraSettings(160, 120, supersample=factor)).render(YARD.start).astype(int)
        for factor in (1, 2, 6)
    )
    assert plain.shape == better.shape == best.shape
    assert np.abs(better - best).mean() < 0.75 * np.abs(plain - best).mean()


def test_shadows_darken_the_ground_only() -> None:
    pose = YARD.start
    with_shade, without = (SceneCamera(YARD, CameraSettings(160, 120, shadows=on)).render(pose) for on in (True, False))
    difference = without.astype(int) - with_shade.astype(int)
    assert difference[70:].mean() > 1
    np.testing.assert_array_equal(with_shade[:40], without[:40])
