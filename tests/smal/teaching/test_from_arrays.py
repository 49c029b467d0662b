"""Arrays of a user that are invalid are rejected before anything is computed, by drive and frame."""

import math
from collections.abc import Callable
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

import smal
from smal.camera import Camera
from tests import corridor

IMAGES, ATOMS, POSES = corridor.drive()
FRAMES = len(ATOMS)


def changed(values: Any, frame: int, value: object) -> list[Any]:
    return [value if k == frame else one for k, one in enumerate(values)]


@pytest.mark.parametrize(
    ("drive", "words"),
    [
        ((IMAGES, ATOMS, changed(POSES, 7, (math.nan, 0.0, 0.0))), "drive-0, frame 7: the pose"),
        ((IMAGES, ATOMS, [pose[:2] for pose in POSES]), "drive-0, frame 0: the pose must be three"),
        ((IMAGES, ATOMS, POSES[:-1]), f"drive-0: {FRAMES} images, but {FRAMES - 1} poses"),
        ((IMAGES, ATOMS[:-1]), f"{FRAMES - 1} actions; give the action after each image"),
        (
            (IMAGES, changed(ATOMS, 3, "forward")),
            "drive-0, frame 3: the action 'forward' is invalid",
        ),
        ((IMAGES, ["forward"] * FRAMES), "frame 0: the action 'forward' is invalid; use smal.Atom"),
        ((IMAGES, changed(ATOMS, 3, 9)), "drive-0, frame 3: the action 9 is invalid"),
        ((IMAGES, changed(ATOMS, 3, math.nan)), "drive-0, frame 3: the action nan is invalid"),
        (([], []), "drive-0 has no images"),
        ((changed(IMAGES, 2, None), ATOMS), "drive-0, frame 2: an image must be an array"),
        ((changed(IMAGES, 2, IMAGES[2][10:]), ATOMS), "frame 2: .* another view than the first"),
        ((changed(IMAGES, 2, IMAGES[2] / 255.0), ATOMS), "frame 2: an image must be .* uint8"),
        (IMAGES, "drive-0 must be .images, atoms. or"),
        ((IMAGES, np.zeros((FRAMES, 1), dtype=int)), "frame 0: the action array"),
        ((IMAGES, ATOMS, changed(POSES, 7, "abc")), "drive-0, frame 7: the pose .* got 'abc'"),
        ((IMAGES, ATOMS, changed(POSES, 7, (1j, 0, 0))), "drive-0, frame 7: the pose must be"),
        ((IMAGES, ATOMS, changed(POSES, 7, [[0], [0], [0]])), "drive-0, frame 7: the pose must be"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_drive_is_rejected_when_it_is_invalid(drive: Any, words: str) -> None:
    with (
        patch("smal.teaching.demonstration.extract", side_effect=AssertionError("computed")),
        pytest.raises(ValueError, match=words) as rejected,
    ):
        smal.fit([drive], corridor.FEATURES)
    assert "\n" not in str(rejected.value)


def test_headings_are_rejected_when_they_are_in_degrees() -> None:
    turns = np.cumsum(np.full(FRAMES, 0.05))
    steps = 0.1 * np.stack([np.cos(turns), np.sin(turns)], axis=1)
    way = np.column_stack([np.cumsum(steps, axis=0), np.append(turns[1:], turns[-1])])
    ahead = np.ones(FRAMES, dtype=np.int8)
    degrees = way * (1.0, 1.0, 180.0 / math.pi)
    with pytest.raises(ValueError, match=r"drive-0: the headings, .* numpy.radians"):
        smal.fit([(IMAGES, ahead, degrees)], corridor.FEATURES)
    wound = np.add(POSES, (0.0, 0.0, 8.0 * math.pi))
    smal.fit([(IMAGES, ATOMS, wound)], corridor.FEATURES)


def test_jump_is_named_when_odometry_was_reset(recwarn: pytest.WarningsRecorder) -> None:
    jumping = [(x + 100.0 * (frame > 10), y, h) for frame, (x, y, h) in enumerate(POSES)]
    smal.fit([(IMAGES, ATOMS, jumping)], corridor.FEATURES)
    (warning,) = recwarn
    assert str(warning.message).startswith("drive-0, frame 11: the odometry jumps by 100 m")


def test_images_are_named_when_a_lazy_sequence_is_damaged() -> None:
    class Lazy(list[Any]):
        pass

    class Sequence:
        def __len__(self) -> int:
            return FRAMES

        def __getitem__(self, frame: int) -> Any:
            return None if frame == 5 else IMAGES[frame]

    with pytest.raises(ValueError, match="drive-0, frame 5: an image must be an array"):
        smal.fit([(Sequence(), ATOMS)], corridor.FEATURES)


@pytest.mark.parametrize(
    ("use", "words"),
    [
        (lambda: smal.Robot("way.smal"), "smal.Model.load"),
        (lambda: smal.fit([(IMAGES, ATOMS)], camera=70.0), "Camera.of_field"),
        (lambda: smal.fit([(IMAGES, ATOMS)], features="hog"), "smal.FeatureSettings, got 'hog'"),
        (lambda: smal.fit([(IMAGES, ATOMS)], goals="x"), "goals must be a list of names, got 'x'"),
        (lambda: smal.fit([(IMAGES, ATOMS)], goals=[3]), "goals must be a list of names"),
        (lambda: smal.fit(None), "drives must be a list or an array, got NoneType"),
        (lambda: smal.fit(drive for drive in [(IMAGES, ATOMS)]), "drives must be a list"),
        (lambda: smal.fit([(iter(IMAGES), ATOMS)]), "drive-0: the images must be a list"),
        (lambda: smal.fit([(IMAGES, None)]), "drive-0: the actions must be a list"),
        (lambda: smal.fit([(IMAGES, ATOMS, 5)]), "drive-0: the poses must be a list"),
        (lambda: smal.learn(["drives"]), "smal.recordings.read.path. reads recordings"),
    ],
)
def test_wrong_kind_of_object_is_rejected(use: Callable[[], object], words: str) -> None:
    with pytest.raises(TypeError, match=words):
        use()


def test_goals_are_rejected_when_drives_have_none() -> None:
    with pytest.raises(ValueError, match="2 goals for 1 drives"):
        smal.fit([(IMAGES, ATOMS)], goals=["a", "b"])


def test_progress_is_reported_when_a_model_is_fitted() -> None:
    stages = set()
    smal.fit(
        [(IMAGES, ATOMS, POSES)],
        corridor.FEATURES,
        progress=lambda stage, _done, _total: stages.add(stage),
    )
    assert stages == {"frames", "views"}


@pytest.mark.parametrize("swapped", [True, False])
def test_robot_warns_when_red_and_blue_are_swapped(
    swapped: bool, recwarn: pytest.WarningsRecorder
) -> None:
    robot = smal.Robot(smal.fit([(IMAGES, ATOMS, POSES)], corridor.FEATURES, camera=Camera(0.7)))
    recwarn.clear()
    for image, pose in zip(IMAGES[:12], POSES[:12], strict=True):
        robot.step(image[..., ::-1] if swapped else image, pose)
    assert [warning.category for warning in recwarn] == [UserWarning] * swapped
    for wrong in (POSES[12][:2], "abc"):
        with pytest.raises(ValueError, match="three finite numbers"):
            robot.step(IMAGES[12], wrong)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="another view than the taught images"):
        robot.step(IMAGES[12][10:])
