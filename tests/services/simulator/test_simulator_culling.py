"""Hiding what a camera cannot see changes no pixel, whatever was drawn before."""

from __future__ import annotations

import math

import numpy as np
import pytest

from services.simulator.scene.occlusion import Occluders
from services.simulator.scene.rendering import SceneCamera
from services.simulator.sensors.camera import CameraSettings
from services.simulator.sensors.shake import LEVEL, Tilt
from services.simulator.world import load_world
from services.simulator.world.place import Pose

pytestmark = pytest.mark.rendering

CAMPUS = load_world("campus")


@pytest.fixture(scope="module")
def camera() -> SceneCamera:
    return SceneCamera(CAMPUS, CameraSettings(160, 120))


def poses(count: int) -> list[Pose]:
    rng = np.random.default_rng(4)
    places = zip(*rng.uniform(-90, 90, (2, count)), rng.uniform(-math.pi, math.pi, count), strict=True)
    return [Pose(float(x), float(y), float(heading)) for x, y, heading in places]


def test_cells_out_of_view_are_hidden_and_no_pixel_changes(
    camera: SceneCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    every = len(camera._cells.surfaces)
    culled, hidden = [], 0
    for pose in poses(20):
        culled.append(camera.render(pose))
        hidden += every + 1 - len(camera._stage.shown)
    assert hidden > 20 * every / 4
    # A camera that sees all around, for the cells only.
    monkeypatch.setattr(camera, "_tangents", (1e9, 1e9))
    monkeypatch.setattr(camera, "_horizon_m", 1e9)
    whole = []
    for pose in poses(20):
        camera._seen_from = None
        whole.append(camera.render(pose))
        assert len(camera._stage.shown) > every / 3
    np.testing.assert_array_equal(culled, whole)


@pytest.mark.parametrize("tilt", [LEVEL, Tilt(0.06, -0.05, 0.1)])
def test_cells_behind_buildings_are_left_out_and_no_pixel_changes(
    camera: SceneCamera, monkeypatch: pytest.MonkeyPatch, tilt: Tilt
) -> None:
    camera._seen_from = None
    culled, few = [], 0
    for pose in poses(30):
        culled.append(camera.render(pose, tilt))
        few += len(camera._stage.shown)
    monkeypatch.setattr(camera, "_occluders", Occluders([]))
    whole, many = [], 0
    for pose in poses(30):
        camera._seen_from = None
        whole.append(camera.render(pose, tilt))
        many += len(camera._stage.shown)
    np.testing.assert_array_equal(culled, whole)
    assert few < 0.7 * many


def test_a_picture_depends_on_nothing_that_was_drawn_before(camera: SceneCamera) -> None:
    wanted = poses(8)
    first = [camera.render(pose) for pose in wanted]
    again = [camera.render(pose) for pose in reversed(wanted)]
    np.testing.assert_array_equal(first, again[::-1])
