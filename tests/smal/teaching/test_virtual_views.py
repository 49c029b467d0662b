"""Virtual views against a camera at the same pose."""

import math
from collections.abc import Iterable

import numpy as np
import pytest
from numpy.typing import NDArray

from smal.camera import Camera, Image, Scene
from smal.features import Centering, extract
from smal.teaching.calibration import TaughtFrames, fit_camera, fit_scene, turn_of_views
from tests.smal.synthetic_world import (
    CAMERA,
    CAMERA_HEIGHT,
    COLOR,
    FIELD_DEG,
    TURN_RAD_S,
    Drive,
    Room,
    drive,
    from_beside,
)

ROWS = 144
COLUMNS = 192
MIDDLE = (6.0, 6.0, 0.3)  # In the middle of a room, whose walls are then all about as far away.
ROOM = Room(half=8.0)
PAINTED = Room()  # Painted once.
LENSES = {
    "rectilinear": Camera.of_field(FIELD_DEG),
    "barrel": Camera(0.7, "plumb_bob", (-0.25, 0.06, 0.0, 0.0)),
    "rational": Camera(0.6, "rational_polynomial", (0.5, 0.1, 0.0, 0.0, 0.02, 0.8, 0.2, 0.03)),
    "fisheye": Camera(0.35, "equidistant", (-0.03, 0.002)),
}


def difference(one: Image, other: Image) -> float:
    """Return the mean difference of two images, grey levels."""
    return float(np.abs(one.astype(float) - other.astype(float)).mean())


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize(
    ("ahead", "left", "turn_deg"),
    [
        (0, 0, 20),
        (0, 0, -20),
        (0.2, 0, 0),
        (-0.1, 0, 0),
        (0, 0.15, 0),
        (0, -0.15, 0),
        (0.15, 0.1, 10),
    ],
)
def test_warped_view_matches_a_camera_there(
    lens: str, ahead: float, left: float, turn_deg: float
) -> None:
    camera = LENSES[lens]
    turn = math.radians(turn_deg)
    scene = Scene(camera, CAMERA_HEIGHT, 8.4)
    here = ROOM.look(MIDDLE, ROWS, COLUMNS, camera)
    there = ROOM.look(from_beside(MIDDLE, ahead, left, turn), ROWS, COLUMNS, camera)
    warped = scene.warp(here, (ahead, left, turn))
    to_the_wrong_side = scene.warp(here, (-ahead, -left, -turn))
    # What both see of the wall, and of the ground that is near enough to be drawn well.
    side = round(COLUMNS * (0.1 + abs(turn_deg) / FIELD_DEG))
    for rows in (slice(ROWS // 4, ROWS // 2 - 4), slice(ROWS * 13 // 20, ROWS * 17 // 20)):
        where = (rows, slice(side, COLUMNS - side))
        off = difference(warped[where], there[where])
        assert off < 3.0
        assert off < difference(here[where], there[where]) / 2.5
        assert off < difference(to_the_wrong_side[where], there[where]) / 2.5


def raw_of(images: Iterable[Image]) -> NDArray[np.float32]:
    return np.stack([extract(image, COLOR) for image in images])


def fitted(room: Room, one: Drive, seen_by: Camera = CAMERA, told: Camera | None = None) -> Scene:
    images = [room.look(pose, camera=seen_by) for pose in one.poses]
    raw = raw_of(images)
    centering = Centering.fit(raw, COLOR)
    drives = np.zeros(len(images), dtype=np.int32)

    def describe(views: Iterable[Image]) -> NDArray[np.float32]:
        return centering.apply(raw_of(views))

    def centred(some: Iterable[int]) -> NDArray[np.float32]:
        return centering.apply(raw[list(some)])

    frames = TaughtFrames(images, centred, one.poses, drives, describe, np.zeros((5, 2)))
    return fit_scene(frames, told or fit_camera(frames), 0.6)


def test_camera_is_fitted_to_a_drive() -> None:
    found = fitted(Room(), drive())
    assert found.camera.lens == "plumb_bob"
    assert found.camera.field_deg == pytest.approx(FIELD_DEG, abs=5.0 + 1e-6)
    assert found.height == pytest.approx(CAMERA_HEIGHT, rel=0.25)
    # The walls are 2 to 9 metres away.
    assert 1.5 < found.distance < 12.0


def test_uncalibrated_wide_lens_is_noticed() -> None:
    found = fitted(Room(), drive(), Camera.of_field(130.0, "equidistant")).camera
    assert found.lens == "equidistant"
    assert found.field_deg == pytest.approx(130.0, abs=10.0 + 1e-6)


def test_drive_without_turns_assumes_or_keeps_a_camera() -> None:
    straight = drive(way=((2.0, 0.0),), rate_hz=5.0)
    assert fitted(Room(), straight).camera.field_deg == pytest.approx(70.0)
    found = fitted(Room(), straight, told=CAMERA)
    assert found.camera == CAMERA
    assert found.height == pytest.approx(CAMERA_HEIGHT, rel=0.25)


@pytest.mark.parametrize(("speed", "rate_hz"), [(2.0, 10.0), (0.5, 20.0)])
def test_turn_of_an_atom_is_measured_on_views(speed: float, rate_hz: float) -> None:
    one = drive(speed=speed, rate_hz=rate_hz)
    images = [PAINTED.look(pose) for pose in one.poses]
    centering = Centering.fit(raw_of(images), COLOR)
    # The second drive's last frame does not turn into the first one's.
    found = turn_of_views(
        images * 2, [one.atoms] * 2, [CAMERA], lambda views: centering.apply(raw_of(views))
    )
    assert found[1] == pytest.approx(TURN_RAD_S * speed / rate_hz, rel=0.15)
