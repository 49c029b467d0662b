"""The tag's pose from one image, against images drawn at known poses by another projection."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.camera import Calibration
from services.tracker.tag_tracking import Tag, TagNotSeen, TagPose, locate
from tests.services.tracker.overhead_images import Shot, photograph

TAG = Tag(number=7, side_m=0.2, height_m=0.43)
SIZE = (1024, 768)  # 1024 x 768 pixels from 4.2 m: 29.7 pixels a side.
CAMERA = Calibration(
    focal_px=560.0,
    centre_x_px=512.0,
    centre_y_px=384.0,
    x_m=4.0,
    y_m=3.0,
    height_m=4.2,
    up_rad=math.pi / 2,
)
_angles = st.floats(-math.pi, math.pi)
# Share of the way from the middle to where the tag touches the edge: nearer, noise hides 3 or 4
# of 100 (seen by trying 400).
_shares = st.floats(-0.95, 0.95)


def changed(camera: Calibration, **fields: float) -> Calibration:
    return camera.model_copy(update=fields)


def angle(difference: float) -> float:
    """Return the size of an angle, degrees."""
    return abs(math.degrees(math.remainder(difference, math.tau)))


def miss(found: TagPose, pose: tuple[float, float, float]) -> tuple[float, float]:
    """Return how far a found pose is off, metres and degrees."""
    return math.hypot(found.x_m - pose[0], found.y_m - pose[1]), angle(found.heading_rad - pose[2])


def place(
    camera: Calibration, size: tuple[int, int], across: float, down: float
) -> tuple[float, float]:
    """Return a point on the tag's plane: -1 to 1 are the ends of where the whole white card is in the image."""
    scale = (camera.height_m - TAG.height_m) / camera.focal_px
    right_m, down_m = (
        share * (n / 2 * scale - 0.2) for share, n in zip((across, down), size, strict=True)
    )
    up = np.array([math.cos(camera.up_rad), math.sin(camera.up_rad)])
    x, y = np.array([camera.x_m, camera.y_m]) + right_m * np.array([up[1], -up[0]]) - down_m * up
    return float(x), float(y)


@settings(max_examples=12, deadline=None)
@given(
    _shares, _shares, _angles, _angles, st.floats(0.3, 1.0), st.floats(0, 6), st.integers(0, 2**32 - 1)
)  # fmt: skip
def test_pose_is_within_a_centimetre_and_a_degree(
    across: float, down: float, heading: float, up: float, blur: float, noise: float, seed: int
) -> None:
    camera = changed(CAMERA, up_rad=up)
    pose = (*place(camera, SIZE, across, down), heading)
    found = locate(TAG, photograph(Shot(camera, SIZE, pose, blur, noise, seed), TAG), camera)
    away_m, turned_deg = miss(found, pose)
    assert away_m < 0.01
    assert turned_deg < 1.0
    assert found.error_px < 0.5


@settings(max_examples=10, deadline=None)
@given(st.floats(300, 1500), _angles, _shares, _shares, st.integers(0, 2**32 - 1))
def test_accuracy_holds_from_16_to_80_pixels_a_side(
    focal_px: float, heading: float, across: float, down: float, seed: int
) -> None:
    size = (400, 304)
    camera = changed(CAMERA, focal_px=focal_px, centre_x_px=210.0, centre_y_px=140.5)
    middle = changed(camera, centre_x_px=200.0, centre_y_px=152.0)
    pose = (*place(middle, size, across / 2, down / 2), heading)
    found = locate(TAG, photograph(Shot(camera, size, pose, seed=seed), TAG), camera)
    away_m, turned_deg = miss(found, pose)
    assert away_m < 0.01
    assert turned_deg < 1.0


def not_seen(image: np.ndarray, camera: Calibration = CAMERA, tag: Tag = TAG) -> str:
    with pytest.raises(TagNotSeen) as reason:
        locate(tag, image, camera)
    assert "\n" not in str(reason.value)
    return str(reason.value)


@pytest.mark.parametrize(
    ("shown", "camera", "tag", "why"),
    [
        *(
            ([replace(TAG, number=number)], CAMERA, TAG, "no markers with number 7")
            for number in (6, 49)
        ),
        ([TAG, TAG], CAMERA, TAG, "2 markers with number 7"),
        ([TAG], CAMERA, replace(TAG, side_m=0.23), "check the tag, its height and the calib"),
        ([TAG], CAMERA, replace(TAG, height_m=0.0), "check the tag, its height and the calib"),
        ([TAG], changed(CAMERA, focal_px=640.0), TAG, "check the tag, its height and the calib"),
    ],
)
def test_tag_is_not_seen_when_another_one_is_shown(
    shown: list[Tag], camera: Calibration, tag: Tag, why: str
) -> None:
    image = photograph(Shot(CAMERA, SIZE, (4.0, 3.0, 0.3)), *shown)
    assert why in not_seen(image, camera, tag)
    if len(shown) == 1:
        assert locate(shown[0], image, CAMERA).x_m == pytest.approx(4.0, abs=0.01)


def test_stretched_image_is_refused() -> None:
    shot = Shot(CAMERA, SIZE, (4.0, 3.0, 0.0))
    image = photograph(shot, TAG)
    # Every tenth row shown twice: the tag is 10 % too long one way, 5 % on average.
    stretched = np.repeat(image, 1 + (np.arange(len(image)) % 10 == 0), axis=0)[38 : 38 + SIZE[1]]
    assert "is not a square of 0.2 m" in not_seen(np.ascontiguousarray(stretched))


def seen_right_or_not_at_all(
    image: np.ndarray, camera: Calibration, pose: tuple[float, float, float]
) -> bool:
    try:
        found = locate(TAG, image, camera)
    except TagNotSeen:
        return False
    away_m, turned_deg = miss(found, pose)
    assert away_m < 0.03
    assert turned_deg < 2.0
    return True


@settings(max_examples=15, deadline=None)
@given(
    _angles, st.floats(-0.25, 0.25), st.booleans(), st.floats(0.2, 0.8), st.integers(0, 2**32 - 1)
)
def test_tag_across_the_border_is_seen_right_or_not_at_all(
    heading: float, outside_m: float, side: bool, along: float, seed: int
) -> None:
    camera = changed(CAMERA, centre_x_px=150.0, centre_y_px=100.0, x_m=0.0, y_m=0.0, height_m=4.2)
    scale = 3.77 / 560
    x, y = (150 * scale + outside_m, (along - 0.5) * 200 * scale) if side else (
        (along - 0.5) * 300 * scale, 100 * scale + outside_m
    )  # fmt: skip
    image = photograph(Shot(camera, (300, 200), (x, y, heading), seed=seed), TAG)
    seen = seen_right_or_not_at_all(image, camera, (x, y, heading))
    # The nearest corner of the black square is outside, or the whole card inside and three pixels more: with less,
    # noise at the border hides one in fifty.
    nearest = 0.1 * (abs(math.cos(heading)) + abs(math.sin(heading)))
    assert not (seen and outside_m + nearest > 0.01)
    assert seen or outside_m > -0.2 - 3 * scale


@settings(max_examples=15, deadline=None)
@given(_angles, _angles, st.floats(0.0, 0.19), st.integers(0, 2**32 - 1))
def test_covered_tag_is_seen_right_or_not_at_all(
    heading: float, towards: float, from_m: float, seed: int
) -> None:
    # Something grey with a straight edge lies over everything further than `from_m` in one direction.
    direction = np.array([math.cos(towards), math.sin(towards)])
    beside = np.array([-direction[1], direction[0]])
    cover = np.array(
        [
            from_m * direction - beside,
            direction - beside,
            direction + beside,
            from_m * direction + beside,
        ]
    )
    camera = changed(CAMERA, centre_x_px=100.0, centre_y_px=100.0, x_m=0.0, y_m=0.0, height_m=4.2)
    pose = (0.05, -0.03, heading)
    image = photograph(Shot(camera, (200, 200), pose, seed=seed), TAG, cover=cover)
    seen = seen_right_or_not_at_all(image, camera, pose)
    assert seen or from_m < 0.189
    assert not seen or from_m > 0.05


def test_camera_below_the_tag_is_an_error_that_names_both() -> None:
    image = np.zeros((48, 64, 3), dtype=np.uint8)
    below = changed(CAMERA, x_m=0.0, y_m=0.0, height_m=0.43)
    with pytest.raises(
        ValueError, match=r"0\.43 m above the floor cannot look down on a tag at 0\.43 m"
    ):
        locate(TAG, image, below)


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**32 - 1))
def test_any_image_is_answered(width: int, height: int, seed: int) -> None:
    image = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    not_seen(image)
