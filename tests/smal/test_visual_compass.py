"""The turn that a camera sees, against the turn that it makes."""

import math
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from smal.features import Centering, extract
from smal.keyframes import MapConfig
from smal.movement import Atom
from smal.robot import Localizer
from smal.teaching.demonstration import Demonstration
from smal.teaching.mapping import learn
from smal.teaching.movements import usual_turn
from smal.visual_compass import picture_of, shift_between
from tests.smal.synthetic_world import CAMERA, COLOR, FIELD_DEG, TURN_RAD_S, Drive, Room, drive

ROOM = Room()


def bumped(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Paint the robot's own bumper into an image: the part with the strongest contrast."""
    image = image.copy()
    image[-16:, 20:76] = 255
    image[-16:, 20:76:8] = 0
    return image


def turns_of(one: Drive, *, bumper: bool = False) -> NDArray[np.float64]:
    """Return the turns that the camera sees between the frames of a drive, radians; NaN where unknown."""
    images = [ROOM.look(pose) for pose in one.poses]
    raw = np.stack([extract(bumped(image) if bumper else image, COLOR) for image in images])
    centred = Centering.fit(raw, COLOR).apply(raw)
    pictures = [picture_of(row, COLOR) for row in centred]
    shifts = [shift_between(*pair) for pair in pairwise(pictures)]
    return np.array(shifts, dtype=float) * math.radians(FIELD_DEG)


@pytest.mark.parametrize("bumper", [False, True])
@pytest.mark.parametrize("degrees", [170.0, -90.0])
def test_compass_sees_the_turn_of_the_camera(degrees: float, bumper: bool) -> None:
    found = turns_of(drive(way=((0.5, degrees), (0.5, 0.0))), bumper=bumper)
    assert math.degrees(found.sum()) == pytest.approx(degrees, rel=0.15)


def test_compass_sees_no_turn_on_a_straight_way() -> None:
    found = turns_of(drive(way=((3.0, 0.0),)))
    assert np.degrees(np.abs(found)).max() < 1.5
    assert abs(math.degrees(found.sum())) < 10.0


def test_compass_is_silent_when_the_robot_was_carried() -> None:
    ahead = drive(way=((1.0, 0.0),))
    away = drive(start=(8.0, 9.0, 2.0), way=((1.0, 0.0),))
    joined = Drive(np.concatenate([ahead.poses, away.poses]), ahead.atoms)
    found = turns_of(joined)
    carried = len(ahead.poses) - 1
    assert np.isnan(found[carried])
    assert np.isfinite(np.delete(found, carried)).all()


@pytest.mark.parametrize(("speed", "rate_hz"), [(2.0, 10.0), (0.5, 20.0)])
def test_turn_of_an_atom_is_measured_on_views(speed: float, rate_hz: float) -> None:
    one = drive(speed=speed, rate_hz=rate_hz)
    turns = turns_of(one)
    turns[::7] = np.nan
    found = usual_turn([turns] * 2, [one.atoms] * 2)
    assert found == pytest.approx(TURN_RAD_S * speed / rate_hz, rel=0.15)
    straight = np.full_like(one.atoms, Atom.FORWARD)
    assert usual_turn([turns], [straight]) == 0.0


def test_robot_keeps_its_heading_when_commands_are_lost() -> None:
    one = drive()
    images = [ROOM.look(pose) for pose in one.poses]
    raw = [extract(image, COLOR) for image in images]
    taught = Demonstration("drive", np.stack(raw), one.atoms, images=images, camera=CAMERA)
    model = learn([taught], COLOR, config=MapConfig(sampled_views=500))
    localizer = Localizer(model)
    for frame, row in enumerate(raw):
        # The base reports that it stands while it turns.
        atom = Atom(int(one.atoms[frame - 1])) if frame else Atom.STOP
        told = atom if atom == Atom.FORWARD else Atom.STOP
        belief = localizer.observe(row, executed=[told])
        place = belief.summary(1)
        assert belief.lost < 0.5
        assert abs(math.degrees(place.offsets[0, 2])) < 20.0
    assert int(model.mapped.keyframes[place.keyframes[0]]) >= len(raw) - 5
