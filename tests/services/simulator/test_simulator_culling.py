"""Hiding what a camera cannot see changes no pixel, whatever was drawn before."""

from __future__ import annotations

import math

import numpy as np
import pytest

from services.simulator.scene.rendering import SceneCamera
from services.simulator.simulation import CameraSettings
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
        hidden += every + 1 - len(camera._shown)
    assert hidden > 20 * every / 4
    # A camera that sees all around, for the cells only.
    monkeypatch.setattr(camera, "_tangents", (1e9, 1e9))
    monkeypatch.setattr(camera, "_horizon_m", 1e9)
    whole = []
    for pose in poses(20):
        camera._seen_from = None
        whole.append(camera.render(pose))
        assert len(camera._shown) > every / 3
    np.testing.assert_array_equal(culled, whole)


def test_a_picture_depends_on_nothing_that_was_drawn_before(camera: SceneCamera) -> None:
    wanted = poses(8)
    first = [camera.render(pose) for pose in wanted]
    again = [camera.render(pose) for pose in reversed(wanted)]
    np.testing.assert_array_equal(first, again[::-1])
