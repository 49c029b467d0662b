"""Views from where nobody drove, against what a camera there sees."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from smal.calibration import TaughtFrames, fit_scene, turn_of_views
from smal.demonstration import Image
from smal.features import Centering, extract
from smal.virtual_views import Scene
from tests.smal.synthetic_world import (
    CAMERA_HEIGHT,
    COLOR,
    FIELD_DEG,
    SCENE,
    TURN_RAD_S,
    Drive,
    Room,
    drive,
    from_beside,
)

ROWS, COLUMNS = 144, 192
#: In the middle of a room, whose walls are then all about as far away.
MIDDLE = (6.0, 6.0, 0.3)
ROOM = Room(half=8.0)
#: Painted once.
PAINTED = Room()
ROOM_SCENE = Scene(SCENE.focal, CAMERA_HEIGHT, 8.4)


def difference(one: Image, other: Image) -> float:
    """Return the mean difference of two images, grey levels."""
    return float(np.abs(one.astype(float) - other.astype(float)).mean())


@pytest.mark.parametrize(
    ("ahead", "left", "turn_deg"),
    [(0, 0, 20), (0, 0, -20), (0.2, 0, 0), (-0.1, 0, 0), (0, 0.15, 0), (0, -0.15, 0), (0.15, 0.1, 10)],
)
def test_a_warped_view_is_what_a_camera_there_sees(ahead: float, left: float, turn_deg: float) -> None:
    turn = math.radians(turn_deg)
    here = ROOM.look(MIDDLE, ROWS, COLUMNS)
    there = ROOM.look(from_beside(MIDDLE, ahead, left, turn), ROWS, COLUMNS)
    warped = ROOM_SCENE.warp(here, ahead, left, turn)
    to_the_wrong_side = ROOM_SCENE.warp(here, -ahead, -left, -turn)
    # What both see of the wall, and of the ground that is near enough to be drawn well.
    side = round(COLUMNS * (0.1 + abs(turn_deg) / FIELD_DEG))
    for rows in (slice(ROWS // 4, ROWS // 2 - 4), slice(ROWS * 13 // 20, ROWS * 17 // 20)):
        where = (rows, slice(side, COLUMNS - side))
        off = difference(warped[where], there[where])
        assert off < 2.5
        assert off < difference(here[where], there[where]) / 4.0
        assert off < difference(to_the_wrong_side[where], there[where]) / 4.0


def fitted(room: Room, one: Drive, focal: float | None = None) -> Scene:
    images = [room.look(pose) for pose in one.poses]
    raw = np.stack([extract(image, COLOR) for image in images])
    centering = Centering.fit(raw, COLOR)
    drives = np.zeros(len(images), dtype=np.int32)

    def describe(image: Image) -> NDArray[np.float32]:
        return centering.apply(extract(image, COLOR))

    return fit_scene(TaughtFrames(images, centering.apply(raw), one.poses, drives, describe, car=False), 0.6, focal)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_drive_tells_its_camera(seed: int) -> None:
    found = fitted(Room(seed), drive())
    field = math.degrees(2.0 * math.atan(0.5 / found.focal))
    assert field == pytest.approx(FIELD_DEG, abs=5.0 + 1e-6)
    assert found.height == pytest.approx(CAMERA_HEIGHT, rel=0.25)
    # The walls are 2 to 9 metres away.
    assert 1.5 < found.distance < 12.0


def test_a_drive_without_turns_assumes_a_usual_camera_and_a_known_one_is_kept() -> None:
    straight = drive(way=((2.0, 0.0),), rate_hz=5.0)
    assert fitted(Room(), straight).focal == pytest.approx(0.5 / math.tan(math.radians(35.0)))
    found = fitted(Room(), straight, SCENE.focal)
    assert found.focal == SCENE.focal
    assert found.height == pytest.approx(CAMERA_HEIGHT, rel=0.25)


@pytest.mark.parametrize(("speed", "rate_hz"), [(1.0, 10.0), (2.0, 10.0), (1.0, 5.0), (0.5, 20.0)])
def test_views_tell_how_far_an_atom_turns(speed: float, rate_hz: float) -> None:
    one = drive(speed=speed, rate_hz=rate_hz)
    images = [PAINTED.look(pose) for pose in one.poses]
    centering = Centering.fit([np.stack([extract(image, COLOR) for image in images])], COLOR)
    # The second drive's last frame does not turn into the first one's.
    found = turn_of_views(
        images * 2, [one.atoms] * 2, SCENE.focal, lambda image: centering.apply(extract(image, COLOR))
    )
    assert found == pytest.approx(TURN_RAD_S * speed / rate_hz, rel=0.15)
