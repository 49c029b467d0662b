"""Depth against geometry, a tilted camera against rotated rays, and the overhead camera against its calibration."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from services.simulator.camera import CameraSettings
from services.simulator.scene.rendering import SceneCamera
from services.simulator.sensors import LEVEL, ShakeSettings, Tilt
from services.simulator.simulation import Simulation
from services.simulator.world import load_world
from services.simulator.world.place import Pose

pytestmark = pytest.mark.rendering

YARD = load_world("yard")
SIZE = WIDTH, HEIGHT = 160, 120
EYE = YARD.robot.camera
TILTS = [LEVEL, Tilt(0.1, 0, 0), Tilt(0, 0.1, 0), Tilt(0, -0.08, 0), Tilt(0.05, 0.1, -0.2), Tilt(-0.1, 0.03, 0.3)]


@pytest.fixture(scope="module")
def camera() -> SceneCamera:
    return SceneCamera(YARD, CameraSettings(*SIZE))


def rays(focal_px: float, tilt: Tilt = LEVEL) -> NDArray[np.float64]:
    """Return each pixel's ray (height, width, 3) about the robot (ahead, left, up), of length 1 along the axis."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    left, up = -(columns - WIDTH / 2) / focal_px, -(rows - HEIGHT / 2) / focal_px
    return np.stack([np.ones_like(left), left, up], axis=-1) @ tilt.matrix().T


def ground_depth_m(focal_px: float, tilt: Tilt) -> NDArray[np.float64]:
    """Return the depth at which each pixel's ray reaches flat ground."""
    down = -rays(focal_px, tilt)[..., 2]
    return np.where(down > 0, EYE.height_m / np.where(down > 0, down, 1.0), np.inf)


@pytest.mark.parametrize("tilt", TILTS, ids=str)
def test_the_ground_is_as_deep_as_geometry_says(camera: SceneCamera, tilt: Tilt) -> None:
    depth, expected = camera.depth_m(YARD.start, tilt), ground_depth_m(camera.focal_px, tilt)
    assert (depth.shape, depth.dtype) == ((HEIGHT, WIDTH), np.float32)
    # Nearer than this nothing stands around the start; farther than the other the map ends.
    near, there = expected < 2.8, expected < 15
    assert near.mean() > 0.1
    np.testing.assert_allclose(depth[near], expected[near], atol=0.0011)
    assert (depth[there] <= expected[there] + 0.01).all(), "nothing is seen through the ground"


def test_walls_are_as_far_as_the_map_says(camera: SceneCamera) -> None:
    """Along the optical axis, the first thing in the way is found on the map and by the camera."""
    solids = [solid for solid in YARD.place.solids if solid.low_m < EYE.height_m < solid.high_m]
    leaves = shapely.union_all([solid.shape.buffer(3.0) for solid in solids if not solid.opaque])
    checked = 0
    for heading in np.linspace(-math.pi, math.pi, 24, endpoint=False):
        cos, sin = math.cos(heading), math.sin(heading)
        x, y = YARD.start.x + EYE.ahead_m * cos, YARD.start.y + EYE.ahead_m * sin
        sight = shapely.LineString([(x, y), (x + 60 * cos, y + 60 * sin)])
        here = shapely.Point(x, y)
        away = [here.distance(s.shape.intersection(sight)) for s in solids if s.shape.intersects(sight)]
        if not away or leaves.intersects(sight.intersection(here.buffer(min(away)))):
            continue  # The map does not know how far leaves reach.
        depth = camera.depth_m(Pose(YARD.start.x, YARD.start.y, heading))
        middle = depth[HEIGHT // 2 - 1 : HEIGHT // 2 + 1, WIDTH // 2 - 1 : WIDTH // 2 + 1]
        assert np.median(middle) == pytest.approx(min(away), abs=0.02)
        checked += 1
    assert checked >= 6


def test_a_robot_that_drives_sees_a_shaken_picture_and_one_that_stands_does_not(camera: SceneCamera) -> None:
    shaken, steady = (Simulation(YARD, camera, shake=ShakeSettings(strength)) for strength in (1.0, 0.0))
    for simulation in (shaken, steady):
        simulation.reset(3, "run")
    np.testing.assert_array_equal(shaken.look().image, steady.look().image)
    differences = []
    for _ in range(5):
        for simulation in (shaken, steady):
            simulation.advance("forward", 1.0, 0.1)
        image = shaken.look().image
        differences.append(np.abs(image.astype(int) - steady.look().image).mean())
        np.testing.assert_array_equal(shaken.look().image, image)
        assert not np.array_equal(shaken.look().depth_m, steady.look().depth_m)
    assert np.mean(differences) > 3
    for simulation in (shaken, steady):
        simulation.advance("stop", 1.0, 1.5)
    np.testing.assert_array_equal(shaken.look().image, steady.look().image)


# -- overhead ---------------------------------------------------------------------------------------------------------
