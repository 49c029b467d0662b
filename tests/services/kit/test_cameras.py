"""Cameras in messages, and their images as JPEG."""

import math
from types import SimpleNamespace
from typing import Any, get_args

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.camera import CameraInfo
from services.kit.cameras import camera_info, camera_of, camera_of_ros
from services.kit.jpeg import decode_jpeg, encode_jpeg
from smal.camera import Camera, Lens
from tests.schemas.messages import EXAMPLES

CAUSE = EXAMPLES[CameraInfo]
NUMBERS = st.floats(allow_nan=True, allow_infinity=True)


def ros(**fields: Any) -> Any:
    k = [300.0, 0.0, 330.0, 0.0, 300.0, 230.0, 0.0, 0.0, 1.0]
    usual = {"width": 640, "height": 480, "k": k, "d": [], "distortion_model": ""}
    return SimpleNamespace(**usual | fields)


@given(
    st.floats(0.04, 12.0),
    st.sampled_from(get_args(Lens)),
    st.lists(st.floats(-1e6, 1e6), max_size=8).map(tuple),
    st.tuples(st.floats(-0.5, 0.5), st.floats(-0.375, 0.375)),
)
def test_a_camera_comes_back(
    focal: float, lens: Lens, distortion: tuple[float, ...], centre: Any
) -> None:
    camera = Camera(focal, lens, distortion, centre)
    back = camera_of(camera_info(CAUSE, camera, 640, 480))
    assert (back.lens, back.distortion) == (lens, distortion)
    assert (back.focal, *back.centre) == pytest.approx((focal, *centre), abs=1e-9)
    assert 0.0 < back.field_deg <= 360.0


@settings(max_examples=20)
@given(
    st.lists(NUMBERS, min_size=9, max_size=9),
    st.lists(NUMBERS, max_size=14),
    st.integers(0, 2**32 - 1),
    st.text(),
)
def test_ros_camera_is_valid_or_refused(
    k: list[float], d: list[float], width: int, lens: str
) -> None:
    try:
        camera = camera_of_ros(ros(k=k, d=d, width=width, distortion_model=lens))
    except ValueError:
        return
    assert math.isfinite(camera_info(CAUSE, camera, 160, 120).centre_y_px)


def test_a_calibration_of_ros_is_taken_as_it_is() -> None:
    camera = camera_of_ros(ros(d=[-0.2, 0.05, 0.001, 0.0, 0.0], distortion_model="plumb_bob"))
    assert camera == Camera(
        300.0 / 640.0, "plumb_bob", (-0.2, 0.05, 0.001, 0.0, 0.0), (10.0 / 640.0, -10.0 / 640.0)
    )
    assert camera_of_ros(ros()).lens == "plumb_bob"
    with pytest.raises(ValueError, match="thin_prism"):
        camera_of_ros(ros(d=[0.1], distortion_model="thin_prism"))
    with pytest.raises(ValueError, match="not calibrated"):
        camera_of_ros(ros(k=[0.0] * 9))


ROWS, COLUMNS = np.mgrid[0:96, 0:128]
SMOOTH = np.stack([COLUMNS, ROWS, (COLUMNS + ROWS) // 2], axis=2).astype(np.uint8)


def test_jpeg_keeps_image_and_channel_order() -> None:
    back = decode_jpeg(encode_jpeg(SMOOTH))
    assert back.shape == SMOOTH.shape
    assert np.abs(back.astype(int) - SMOOTH).mean() < 1.5


def test_a_progressive_jpeg_of_another_program_is_read() -> None:
    _, data = cv2.imencode(".jpg", SMOOTH[:, :, ::-1], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])
    assert decode_jpeg(data.tobytes()).shape == SMOOTH.shape


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xff\xd8",
        b"\xff\xd8\xff\xd9",
        b"no image at all",
        encode_jpeg(SMOOTH)[:100],
        b"\x89PNG\r\n\x1a\n" + bytes(40),
    ],
    ids=["empty", "start", "start and end", "text", "cut in its header", "another format"],
)
def test_data_is_refused_when_it_is_no_jpeg(data: bytes) -> None:
    with pytest.raises(ValueError, match=r"^invalid JPEG image"):
        decode_jpeg(data)


def test_jpeg_is_refused_when_it_claims_an_enormous_image() -> None:
    data = encode_jpeg(SMOOTH)
    at = data.index(b"\xff\xc0") + 5
    with pytest.raises(ValueError, match=r"too large \(maximum 12582912 pixels\)$"):
        decode_jpeg(data[:at] + (32_700).to_bytes(2, "big") * 2 + data[at + 4 :])


def test_image_is_refused_when_jpeg_cannot_hold_it() -> None:
    with pytest.raises(ValueError, match=r"^OpenCV cannot encode a 65536x1 image as JPEG$"):
        encode_jpeg(np.zeros((1, 65536, 3), np.uint8))
