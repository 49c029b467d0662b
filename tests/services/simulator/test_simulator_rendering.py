"""Pixels: repeatable to the bit, the victim where it should be, depth against geometry, the marker seen from above."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from services.simulator.scene.rendering import ROBOT, VICTIM, SceneCamera
from services.simulator.sensors.camera import CameraSettings
from services.simulator.sensors.readings import LEVEL, Tilt
from services.simulator.simulation import Simulation
from services.simulator.world import load_world
from services.simulator.world.place import Pose
from services.simulator.world.route import plan_route
from tests.services.simulator.simulator_driving import camera_in

pytestmark = pytest.mark.rendering

YARD, INDOOR = (load_world(name) for name in ("yard", "indoor"))
WIDTH = 160
HEIGHT = 120
EYE = YARD.robot.camera
TILTS = [
    LEVEL,
    Tilt(0.1, 0, 0),
    Tilt(0, 0.1, 0),
    Tilt(0, -0.08, 0),
    Tilt(0.05, 0.1, -0.2),
    Tilt(-0.1, 0.03, 0.3),
]


def facing_the_victim(name: str, away_m: float) -> Pose:
    """Return a pose that looks at the victim, on the last leg of the route or, indoors, before its face."""
    victim = load_world(name).victim
    corner = plan_route(YARD, (YARD.start.x, YARD.start.y))[-2]
    looks = (
        victim.heading + math.pi
        if name == "indoor"
        else math.atan2(victim.y - corner[1], victim.x - corner[0])
    )
    return Pose(victim.x - away_m * math.cos(looks), victim.y - away_m * math.sin(looks), looks)


def test_an_image_has_something_in_it_and_repeats_to_the_bit() -> None:
    camera = camera_in("indoor")
    other = SceneCamera(INDOOR, CameraSettings(160, 120))
    start = INDOOR.start
    poses = [start, facing_the_victim("indoor", 0.8), Pose(start.x, start.y, start.heading + 1.5)]
    for pose in (*poses, *reversed(poses)):
        image = camera.render(pose)
        assert (image.shape, image.dtype) == ((120, 160, 3), np.uint8)
        assert image.std() > 5
        assert image.max(axis=2).min() > 8
        assert not (camera._labels(pose, LEVEL) == ROBOT).any(), "the robot does not see itself"
        np.testing.assert_array_equal(image, other.render(pose))


def test_moved_camera_shows_the_scene_higher_up_and_larger() -> None:
    level = camera_in("indoor")
    pitched = SceneCamera(INDOOR, CameraSettings(160, 120, pitch_deg=5.0))
    zoomed = SceneCamera(INDOOR, CameraSettings(160, 120, zoom=1.05))
    raised = SceneCamera(INDOOR, CameraSettings(160, 120, raised_m=0.1))
    pose = facing_the_victim("indoor", 1.2)

    def rows(camera: SceneCamera) -> float:
        return float(np.nonzero(camera._labels(pose, LEVEL) == VICTIM)[0].mean())

    # The focal length is 104 pixels: 5 degrees are 9 of them.
    assert rows(level) - rows(pitched) == pytest.approx(9.0, abs=2.0)
    assert zoomed.victim_pixels(pose) == pytest.approx(1.05**2 * level.victim_pixels(pose), rel=0.1)
    assert rows(raised) > rows(level) + 2.0


@pytest.mark.parametrize(
    ("name", "near_m", "nearer_m", "share"), [("yard", 4.5, 3.0, 0.002), ("indoor", 1.2, 0.8, 0.02)]
)
def test_the_victim_is_seen_near_and_facing_and_from_no_start(
    name: str, near_m: float, nearer_m: float, share: float
) -> None:
    camera = camera_in(name)
    near = facing_the_victim(name, near_m)
    assert camera.victim_pixels(near) > share
    assert camera.victim_pixels(facing_the_victim(name, nearer_m)) > camera.victim_pixels(near)
    assert camera.victim_pixels(Pose(near.x, near.y, near.heading + math.pi)) == 0
    simulation = Simulation(load_world(name), camera)
    for seed in range(10):
        start = simulation.reset(seed, "run")
        for turn in (0.0, *(np.linspace(1.0, 6.0, 5) if name == "indoor" else ())):
            assert camera.victim_pixels(Pose(start.x, start.y, start.heading + float(turn))) == 0


def rays(focal_px: float, tilt: Tilt = LEVEL) -> NDArray[np.float64]:
    """Return each pixel's ray (height, width, 3) about the robot (ahead, left, up), of length 1 along the axis."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    left = -(columns - WIDTH / 2) / focal_px
    up = -(rows - HEIGHT / 2) / focal_px
    return np.stack([np.ones_like(left), left, up], axis=-1) @ tilt.matrix().T


def ground_depth_m(focal_px: float, tilt: Tilt) -> NDArray[np.float64]:
    """Return the depth at which each pixel's ray reaches flat ground."""
    down = -rays(focal_px, tilt)[..., 2]
    return np.where(down > 0, EYE.height_m / np.where(down > 0, down, 1.0), np.inf)


@pytest.mark.parametrize("tilt", TILTS, ids=str)
def test_the_ground_is_as_deep_as_geometry_says(tilt: Tilt) -> None:
    camera = camera_in("yard")
    depth = camera.depth_m(YARD.start, tilt)
    expected = ground_depth_m(camera.focal_px, tilt)
    assert (depth.shape, depth.dtype) == ((HEIGHT, WIDTH), np.float32)
    # Nearer than this nothing stands around the start; farther than the other the map ends.
    near = expected < 2.8
    there = expected < 15
    assert near.mean() > 0.1
    np.testing.assert_allclose(depth[near], expected[near], atol=0.0011)
    assert (depth[there] <= expected[there] + 0.01).all(), "nothing is seen through the ground"
