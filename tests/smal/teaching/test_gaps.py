"""Drives without odometry whose recording lacks frames: the whole drive teaches."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from smal.features import extract
from smal.map import VisualMap
from smal.movement import Atom
from smal.teaching.demonstration import Demonstration, Use, described
from smal.teaching.mapping import learn
from tests.smal.synthetic_world import CAMERA, COLOR, Room, drive

ROOM = Room()
WAY = drive(way=((2.5, 90.0), (2.0, 0.0)))
IMAGES = [ROOM.look(pose) for pose in WAY.poses]


def parts(
    frames: Sequence[NDArray[np.int_]], lost: int = 0, *, odometry: bool = False
) -> list[Demonstration]:
    """Return the parts of the drive with these frames, and lost ticks before all but the first."""
    found = []
    for number, some in enumerate(frames):
        images = [IMAGES[frame] for frame in some]
        found.append(
            Demonstration(
                f"part-{number}",
                described(images, COLOR),
                WAY.atoms[some],
                successful=number == len(frames) - 1,
                images=images,
                odometry=WAY.poses[some] if odometry else None,
                episode="drive",
                camera=CAMERA,
                lost=lost if number else 0,
            )
        )
    return found


def taught(demonstrations: Sequence[Demonstration]) -> tuple[VisualMap, list[Use]]:
    uses: list[Use] = []
    return learn(demonstrations, COLOR, report=uses.append).mapped, uses


def length(mapped: VisualMap) -> float:
    """Return the way of a map, in forward atoms."""
    return float(np.hypot(*np.diff(mapped.poses[:, :2], axis=0).T).sum())


def test_drive_is_whole_when_the_robot_stood_in_ten_gaps() -> None:
    cuts = np.array_split(np.arange(len(IMAGES)), 11)
    # The frame before each pause is seen again after it.
    paused = [np.append(one[0] - 1, one) if one[0] else one for one in cuts]
    mapped, uses = taught(parts(paused, lost=50))
    whole, _ = taught(parts([np.arange(len(IMAGES))]))
    assert uses[0].used == len(IMAGES) + 10
    assert uses[0].note == "10 gaps (50.0 s) bridged by views"
    assert length(mapped) == pytest.approx(length(whole), abs=6.0)


@pytest.mark.parametrize("lost", [1, 10])
def test_drive_is_whole_when_the_robot_drove_in_a_gap(lost: int) -> None:
    mapped, _ = taught(parts([np.arange(20), np.arange(20 + lost, len(IMAGES))], lost))
    whole, _ = taught(parts([np.arange(len(IMAGES))]))
    assert mapped.frames.tolist() == [len(IMAGES) - lost]
    assert length(mapped) == pytest.approx(length(whole), abs=0.4 * lost + 1.0)


def test_way_across_a_gap_is_limited_when_views_are_unrelated() -> None:
    apart = np.arange(len(IMAGES) - 8, len(IMAGES))
    mapped, _ = taught(parts([np.arange(30), apart], lost=100_000))
    step = np.hypot(*(mapped.poses[30] - mapped.poses[29])[:2])
    assert 5.0 < step <= len(IMAGES)


def test_gap_is_bridged_by_odometry_when_there_is_any() -> None:
    some = [np.arange(20), np.arange(30, len(IMAGES))]
    mapped, uses = taught(parts(some, 10, odometry=True))
    np.testing.assert_array_equal(mapped.poses, WAY.poses[np.concatenate(some)])
    assert uses[0].note == "1 gap (1.0 s) bridged by odometry"


def test_drives_are_reported_when_they_teach_nothing() -> None:
    (good,) = parts([np.arange(len(IMAGES))])
    failed = replace(good, name="failed", episode="failed", successful=False)
    still = Demonstration(
        "still",
        np.stack([extract(IMAGES[0], COLOR)] * 3),
        np.full(3, Atom.STOP, np.int8),
        images=IMAGES[:1] * 3,
    )
    _, uses = taught([failed, still, good])
    assert [(use.drive, use.used) for use in uses] == [
        ("failed", 0),
        ("still", 0),
        ("drive", len(IMAGES)),
    ]
    assert uses[0].note == "it does not end at the goal"
    assert "the robot hardly moves: by 0 of at least" in uses[1].note
