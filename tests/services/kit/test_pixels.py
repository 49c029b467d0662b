"""Pixels of image files and of raw images of ROS."""

import struct
from collections.abc import Callable
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from services.kit.jpeg import decode_jpeg
from services.kit.pixels import ENCODINGS, BitDepth, decode_file, is_upright, rgb_of

COARSE = np.random.default_rng(1).integers(40, 216, (4, 5, 3), dtype=np.uint8)
PICTURE = cv2.resize(COARSE, (64, 48), interpolation=cv2.INTER_CUBIC)
GREY = cv2.cvtColor(PICTURE, cv2.COLOR_RGB2GRAY)
#: Sites of the colours of a Bayer pattern: rows and columns of red, of both greens, and of blue.
SITES = {
    "rggb": ((0, 0), (0, 1), (1, 0), (1, 1)), "bggr": ((1, 1), (0, 1), (1, 0), (0, 0)),
    "gbrg": ((1, 0), (0, 0), (1, 1), (0, 1)), "grbg": ((0, 1), (0, 0), (1, 1), (1, 0)),
}  # fmt: skip
#: How to store the pixels of an EXIF orientation, so that a viewer shows `PICTURE`.
STORED: dict[int, Callable[[np.ndarray], np.ndarray]] = {
    1: lambda image: image,
    2: lambda image: image[:, ::-1],
    3: lambda image: image[::-1, ::-1],
    4: lambda image: image[::-1],
    5: lambda image: image.transpose(1, 0, 2),
    6: lambda image: np.rot90(image, 1),
    7: lambda image: np.rot90(image, 1)[:, ::-1],
    8: lambda image: np.rot90(image, -1),
}


def mosaic(order: str) -> np.ndarray:
    found = np.zeros((48, 64), np.uint8)
    for (row, column), channel in zip(SITES[order], (0, 1, 1, 2), strict=True):
        found[row::2, column::2] = PICTURE[row::2, column::2, channel]
    return found


def half_chroma() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Y, and U and V of half the rows and columns."""
    planes = cv2.cvtColor(PICTURE, cv2.COLOR_RGB2YUV_I420).ravel()
    return planes[:3072].reshape(48, 64), planes[3072:3840], planes[3840:]


def pairs(*, luma_first: bool) -> np.ndarray:
    luma, u, v = half_chroma()
    colour = np.repeat(np.stack([u, v], axis=-1).reshape(24, 32, 2), 2, axis=0).reshape(48, 64)
    both = (luma, colour) if luma_first else (colour, luma)
    return np.stack(both, axis=-1)


def planes(name: str) -> np.ndarray:
    luma, u, v = half_chroma()
    if name == "i420":
        return np.concatenate([luma.ravel(), u, v]).reshape(72, 64)
    chroma = np.stack([u, v] if name == "nv12" else [v, u], axis=-1)
    return np.concatenate([luma.ravel(), chroma.ravel()]).reshape(72, 64)


def stored(name: str) -> np.ndarray:
    """Return the picture in an encoding, of 8 bits."""
    plain = name.removesuffix("16").removesuffix("8").removeprefix("16").removeprefix("8")
    alpha = np.full((48, 64, 1), 7, np.uint8)
    if plain.startswith("bayer_"):
        return mosaic(plain.removeprefix("bayer_"))
    if plain in ("mono", "UC1"):
        return GREY
    if plain in ("yuv422", "uyvy", "yuv422_yuy2", "yuyv"):
        return pairs(luma_first="yuy" in plain)
    if name in ("nv12", "nv21", "i420"):
        return planes(name)
    colours = PICTURE if plain.startswith("rgb") else PICTURE[..., ::-1]
    return colours if plain in ("rgb", "bgr", "UC3") else np.dstack([colours, alpha])


def message(name: str, *, is_bigendian: bool = False) -> SimpleNamespace:
    """Return the picture as a message whose rows end with two bytes of padding."""
    pixels = stored(name)
    if ENCODINGS[name].bits == 16:
        pixels = (pixels.astype(np.uint16) * 257).astype(">u2" if is_bigendian else "<u2")
    rows = np.ascontiguousarray(pixels).reshape(len(pixels), -1).view(np.uint8)
    data = np.pad(rows, ((0, 0), (0, 2)))
    return SimpleNamespace(
        width=64, height=48, encoding=name, step=data.shape[1], data=data.ravel(),
        is_bigendian=is_bigendian,
    )  # fmt: skip


@pytest.mark.parametrize("name", ENCODINGS)
def test_ros_image_keeps_its_colours_in_every_encoding(name: str) -> None:
    grey = name.startswith("mono") or name.endswith("UC1")
    expected = np.repeat(GREY[..., None], 3, axis=2) if grey else PICTURE
    for is_bigendian in (False, True):
        found = rgb_of(message(name, is_bigendian=is_bigendian))
        assert found.dtype == np.uint8
        assert np.abs(found.astype(int) - expected)[2:-2, 2:-2].mean() < 4.0


def test_ros_image_is_refused_when_height_is_odd() -> None:
    image = SimpleNamespace(
        width=64, height=47, encoding="nv12", step=64, data=np.zeros(64 * 70, np.uint8)
    )
    with pytest.raises(ValueError, match="needs even numbers"):
        rgb_of(image)


def test_image_of_12_bits_is_bright_when_stored_in_16() -> None:
    deep = (PICTURE.astype(np.uint16) << 4) + 3
    np.testing.assert_array_equal(BitDepth().eight_bits(deep), PICTURE)
    np.testing.assert_array_equal(decode_file(png(deep)), PICTURE)
    assert not BitDepth().eight_bits(np.zeros((2, 2), np.uint16)).any()


def test_depth_of_a_stream_is_kept_when_an_image_is_dark() -> None:
    deep = PICTURE.astype(np.uint16) << 4
    depth = BitDepth()
    decode_file(png(deep), depth)
    np.testing.assert_array_equal(decode_file(png(deep // 8), depth), deep // 8 >> 4)


def png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image[..., ::-1])[1].tobytes()


def with_orientation(jpeg: bytes, orientation: int) -> bytes:
    entry = struct.pack("<HHIHH", 0x112, 3, 1, orientation, 0)
    tiff = b"II*\0" + struct.pack("<IH", 8, 1) + entry + struct.pack("<I", 0)
    segment = b"Exif\0\0" + tiff
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + jpeg[2:]


@pytest.mark.parametrize("orientation", STORED)
def test_picture_stands_upright_by_its_orientation(orientation: int) -> None:
    pixels = np.ascontiguousarray(STORED[orientation](PICTURE)[..., ::-1])
    jpeg = with_orientation(cv2.imencode(".jpg", pixels)[1].tobytes(), orientation)
    for decode in (decode_file, decode_jpeg):
        assert np.abs(decode(jpeg).astype(int) - PICTURE).mean() < 3.0
    assert is_upright(jpeg) == (orientation == 1)
