"""Depth against geometry, a tilted camera against rotated rays, and the overhead camera against its calibration."""

from __future__ import annotations

import math
from dataclasses import fields

import cv2
import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from services.simulator.scene.rendering import SceneCamera
from services.simulator.sensors import LEVEL, ShakeSettings, Tilt
from services.simulator.sensors.blur import blur
from services.simulator.sensors.camera import CameraSettings
from services.simulator.sensors.shake import TiltRate
from services.simulator.simulation import Simulation
from services.simulator.world import load_world
from services.simulator.world.place import OverheadMount, Pose, World
from services.simulator.world.terrain import Terrain

pytestmark = pytest.mark.rendering

YARD = load_world("yard")
SIZE = WIDTH, HEIGHT = 160, 120
EYE = YARD.robot.camera
TILTS = [LEVEL, Tilt(0.1, 0, 0), Tilt(0, 0.1, 0), Tilt(0, -0.08, 0), Tilt(0.05, 0.1, -0.2), Tilt(-0.1, 0.03, 0.3)]


@pytest.fixture(scope="module")
def camera() -> SceneCamera:
    return SceneCamera(YARD, CameraSettings(*SIZE))


@pytest.fixture(scope="module")
def large() -> SceneCamera:
    return SceneCamera(YARD, CameraSettings(320, 240))


def rays(focal_px: float, tilt: Tilt = LEVEL) -> NDArray[np.float64]:
    """Return each pixel's ray (height, width, 3) about the robot (ahead, left, up), of length 1 along the axis."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    left, up = -(columns - WIDTH / 2) / focal_px, -(rows - HEIGHT / 2) / focal_px
    return np.stack([np.ones_like(left), left, up], axis=-1) @ tilt.matrix().T


def ground_depth_m(focal_px: float, tilt: Tilt) -> NDArray[np.float64]:
    """Return the depth at which each pixel's ray reaches flat ground."""
    down = -rays(focal_px, tilt)[..., 2]
    return np.where(down > 0, EYE.height_m / np.where(down > 0, down, 1.0), np.inf)


def test_the_focal_length_is_that_of_the_field_of_view(camera: SceneCamera) -> None:
    assert 2 * math.degrees(math.atan(WIDTH / 2 / camera.focal_px)) == pytest.approx(75.0)


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


def test_the_sky_is_infinitely_far(camera: SceneCamera) -> None:
    upwards = camera.depth_m(YARD.start, Tilt(0, -math.pi / 2, 0))
    assert np.isinf(upwards[:, : WIDTH // 2]).all(), "to the right there is a high house"
    assert np.isfinite(upwards[:, -5:]).all()
    depth = camera.depth_m(YARD.start)
    assert 0.3 < np.isinf(depth[0]).mean() < 0.7, "the sky between the houses"
    assert depth[np.isfinite(depth)].max() < 300, "the ground ends there; the painted sky is three times as far"


def test_supersampled_depth_is_that_of_the_same_view(camera: SceneCamera) -> None:
    fine = SceneCamera(YARD, CameraSettings(*SIZE, supersample=2)).depth_m(YARD.start)
    plain = camera.depth_m(YARD.start)
    assert fine.shape == plain.shape
    both = np.isfinite(fine) & np.isfinite(plain)
    assert np.median(np.abs(fine[both] / plain[both] - 1)) < 0.02


@pytest.mark.parametrize("yaw", [0.3, -0.7])
def test_a_camera_that_looks_aside_sees_what_a_robot_sees_that_turned(camera: SceneCamera, yaw: float) -> None:
    start = YARD.start
    turned = start.heading + yaw
    there = Pose(
        start.x + EYE.ahead_m * (math.cos(start.heading) - math.cos(turned)),
        start.y + EYE.ahead_m * (math.sin(start.heading) - math.sin(turned)),
        turned,
    )
    aside, ahead = camera.render(start, Tilt(0, 0, yaw)), camera.render(there)
    assert np.mean(aside != ahead) < 0.01
    np.testing.assert_allclose(camera.depth_m(start, Tilt(0, 0, yaw)), camera.depth_m(there), rtol=0.2, atol=0.01)


def shift(before: NDArray[np.uint8], after: NDArray[np.uint8]) -> tuple[float, float]:
    """Return by how many pixels a picture moved right and down, by phase correlation."""
    grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) for image in (before, after)]
    window = cv2.createHanningWindow((grey[0].shape[1], grey[0].shape[0]), cv2.CV_32F)
    (right, down), _ = cv2.phaseCorrelate(*grey, window)
    return right, down


@pytest.mark.parametrize("degrees", [-2.0, -0.7, 0.7, 2.0])
def test_a_tilt_moves_the_picture_by_the_right_number_of_pixels(large: SceneCamera, degrees: float) -> None:
    """A picture of 320 columns has about 3.6 pixels a degree."""
    angle = math.radians(degrees)
    level, expected = large.render(YARD.start), large.focal_px * math.tan(angle)
    assert shift(level, large.render(YARD.start, Tilt(0, angle, 0))) == pytest.approx((0, -expected), abs=0.6)
    assert shift(level, large.render(YARD.start, Tilt(0, 0, angle))) == pytest.approx((expected, 0), abs=0.6)


def test_a_tilted_camera_is_not_given_the_picture_of_a_level_one(camera: SceneCamera) -> None:
    level, depth = camera.render(YARD.start), camera.depth_m(YARD.start)
    tilted = camera.render(YARD.start, Tilt(0.02, 0.02, 0.02))
    assert not np.array_equal(level, tilted)
    np.testing.assert_array_equal(camera.render(YARD.start), level)
    np.testing.assert_array_equal(camera.depth_m(YARD.start), depth)


@pytest.mark.parametrize(
    "rate", [TiltRate(0, 0.9, 0), TiltRate(0, 0, 0.9), TiltRate(0.9, 0, 0), TiltRate(0.6, 0.6, -0.8)], ids=str
)
def test_blur_is_the_mean_of_what_a_turning_camera_sees(large: SceneCamera, rate: TiltRate) -> None:
    exposure_s = 0.04
    pictures = [
        large.render(YARD.start, Tilt(*(part * exposure_s * axis for axis in rate))).astype(float)
        for part in (np.arange(15) + 0.5) / 15 - 0.5
    ]
    truth, sharp = np.mean(pictures, axis=0)[20:-20, 20:-20], large.render(YARD.start)
    mirrored = TiltRate(-rate.roll_rad_s, rate.pitch_rad_s, -rate.yaw_rad_s)

    def error(image: NDArray[np.uint8]) -> float:
        return float(np.abs(image[20:-20, 20:-20] - truth).mean())

    blurred = error(blur(sharp, rate, exposure_s, large.focal_px))
    assert blurred < 0.35 * error(sharp)
    if sum(axis != 0 for axis in rate) > 1:
        assert blurred < 0.6 * error(blur(sharp, mirrored, exposure_s, large.focal_px)), "the signs belong together"


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

HIGH_M = 14.0


def seen_from_above(up: float) -> World:
    """Return the yard with a camera above its start."""

    class Overlooked(Terrain):
        @property
        def overhead(self) -> OverheadMount:
            return OverheadMount(YARD.start.x + 1.0, YARD.start.y - 0.5, HIGH_M, up, 320, 240, 250.0)

    assert isinstance(YARD.place, Terrain)
    return World(
        Overlooked(**{field.name: getattr(YARD.place, field.name) for field in fields(YARD.place)}),
        YARD.start,
        YARD.victim,
    )


def pixel_of(mount: OverheadMount, x: float, y: float, height_m: float) -> tuple[float, float]:
    """Return column and row of a point, by the pinhole model that the calibration states."""
    east, north, scale = x - mount.x, y - mount.y, mount.focal_px / (mount.height_m - height_m)
    along = east * math.cos(mount.up) + north * math.sin(mount.up)
    right = east * math.sin(mount.up) - north * math.cos(mount.up)
    return mount.width / 2 + scale * right, mount.height / 2 - scale * along


@pytest.mark.parametrize("up", [math.pi / 2, 0.0, -2.0])
def test_the_robot_is_seen_from_above_where_the_calibration_says(up: float) -> None:
    world = seen_from_above(up)
    mount = world.place.overhead
    assert mount is not None
    camera = SceneCamera(world, CameraSettings(*SIZE))
    away = camera.overhead(Pose(mount.x + 100, mount.y, 0.0)).astype(int)
    assert away.shape == (240, 320, 3)
    for dx, dy, heading in [(0.0, 0.0, 0.3), (1.8, 0.0, 2.0), (0.0, 4.5, -1.0), (-1.8, -4.0, 1.4)]:
        pose = Pose(mount.x + dx, mount.y + dy, heading)
        changed = np.abs(camera.overhead(pose) - away).sum(axis=2) > 40
        rows, columns = np.nonzero(changed)
        assert 60 < len(rows) < 1500
        # The middle of the hull is 2.5 cm behind the axis, and a metre is 18 pixels.
        found, expected = (columns.mean() + 0.5, rows.mean() + 0.5), pixel_of(mount, pose.x, pose.y, 0.4)
        assert found == pytest.approx(expected, abs=2.5)


def test_the_overhead_picture_does_not_disturb_the_robot_s_own() -> None:
    camera = SceneCamera(seen_from_above(0.0), CameraSettings(*SIZE))
    before, depth = camera.render(YARD.start), camera.depth_m(YARD.start)
    camera.overhead(Pose(YARD.start.x + 2.0, YARD.start.y, 1.0))
    np.testing.assert_array_equal(camera.render(YARD.start), before)
    np.testing.assert_array_equal(camera.depth_m(YARD.start), depth)
    camera.render(Pose(YARD.start.x, YARD.start.y, 2.0))
    np.testing.assert_array_equal(camera.render(YARD.start), before)


def test_all_pictures_of_a_frame_are_of_one_scene(capfd: pytest.CaptureFixture[str]) -> None:
    """The renderer complains of a picture that was taken before the scene last changed."""
    simulation = Simulation(seen_from_above(0.0), CameraSettings(*SIZE), shake=ShakeSettings())
    simulation.reset(1, "run")
    for atom in ("forward", "forward", "stop", "stop"):
        simulation.advance(atom, 1.0, 0.5)  # type: ignore[arg-type]
        view = simulation.look()
        image, depth, above = view.image, view.depth_m, view.overhead
        view = simulation.look()
        np.testing.assert_array_equal(view.depth_m, depth)
        np.testing.assert_array_equal(view.overhead, above)
        np.testing.assert_array_equal(view.image, image)
    simulation.advance("forward", 1.0, 0.1)
    view = simulation.look()
    assert view.overhead.size
    assert view.image.size
    assert "picture" not in "".join(capfd.readouterr())


def test_a_place_without_an_overhead_camera_says_so(camera: SceneCamera) -> None:
    simulation = Simulation(YARD, camera)
    assert simulation.world.place.overhead is None
    with pytest.raises(LookupError, match="no overhead camera"):
        assert simulation.look().overhead.size
