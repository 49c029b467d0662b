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


@pytest.mark.parametrize("tilt", [LEVEL, Tilt(0.06, -0.05, 0.1)])
def test_what_is_out_of_view_or_behind_buildings_is_left_out_and_no_pixel_changes(
    camera: SceneCamera, monkeypatch: pytest.MonkeyPatch, tilt: Tilt
) -> None:
    def seen() -> tuple[list[np.ndarray], int]:
        pictures, shown = [], 0
        for pose in poses(25):
            camera._seen_from = None
            pictures.append(camera.render(pose, tilt))
            shown += len(camera._stage.shown)
        return pictures, shown

    culled, few = seen()
    monkeypatch.setattr(camera, "_occluders", Occluders([]))
    through, more = seen()
    # A camera that sees all around, for the cells only.
    monkeypatch.setattr(camera, "_tangents", (1e9, 1e9))
    monkeypatch.setattr(camera, "_horizon_m", 1e9)
    whole, every = seen()
    np.testing.assert_array_equal(culled, whole)
    np.testing.assert_array_equal(through, whole)
    assert few < 0.7 * more < 0.7 * every


def test_a_picture_depends_on_nothing_that_was_drawn_before(camera: SceneCamera) -> None:
    wanted = poses(8)
    first = [camera.render(pose) for pose in wanted]
    again = [camera.render(pose) for pose in reversed(wanted)]
    np.testing.assert_array_equal(first, again[::-1])
