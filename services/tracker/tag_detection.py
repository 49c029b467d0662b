"""Corners of an ArUco marker in an image, to a small fraction of a pixel."""

from functools import cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

# Cells along a marker's side in DICT_4X4_50: four of code between two of black border.
_CELLS: Final = 6
#: Search distance around the expected edge; beyond it, the edge of the next cell interferes.
_REACH_CELLS: Final = 0.5
_MARGIN: Final = 0.12  # Excluded share at the ends of an edge: blur rounds the corners.
_PROFILES: Final = 24
_SAMPLES: Final = 13
# OpenCV's corners are about a pixel off. Each round reduces the error to a tenth.
_ROUNDS: Final = 3


@cache
def _detector() -> cv2.aruco.ArucoDetector:
    parameters = cv2.aruco.DetectorParameters()
    # For cells only 3 pixels wide, blurred rims hide the code with OpenCV's defaults of 4 pixels
    # and 0.13.
    parameters.perspectiveRemovePixelPerCell = 8
    parameters.perspectiveRemoveIgnoredMarginPerCell = 0.25
    return cv2.aruco.ArucoDetector(
        cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), parameters
    )


def find_markers(image: NDArray[np.uint8], number: int) -> list[NDArray[np.float64]]:
    """Return the corners (4, 2) of each marker with a number in an RGB image, clockwise, pixels.

    The first corner is the marker's own upper left; the first pixel's centre is at 0.5. OpenCV fits
    each corner separately, which at 30 pixels a side and a narrow margin errs by up to 2.6 pixels.
    Here corners are the intersections of lines along the sides.
    """
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    quads, numbers, _ = _detector().detectMarkers(grey)
    if not quads:
        return []
    # OpenCV's origin is the centre of the first pixel.
    found = [
        quad[0].astype(np.float64)
        for quad, one in zip(quads, numbers.ravel(), strict=True)
        if one == number
    ]
    for _ in range(_ROUNDS):
        found = [_meeting(*_sides(grey, corners)) for corners in found]
    return [corners + 0.5 for corners in found]


def _sides(
    grey: cv2.typing.MatLike, corners: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Fit a line to the outer edge of each side; return its starts and ends (4, 2)."""
    along = np.roll(corners, -1, axis=0) - corners
    lengths = np.hypot(along[:, 0], along[:, 1])
    outward = np.column_stack([along[:, 1], -along[:, 0]]) / lengths[:, np.newaxis]
    reach = _REACH_CELLS * lengths.mean() / _CELLS
    fractions = np.linspace(_MARGIN, 1 - _MARGIN, _PROFILES)
    offsets = np.linspace(-reach, reach, _SAMPLES)
    feet = corners[:, np.newaxis] + fractions[:, np.newaxis] * along[:, np.newaxis]
    points = feet[:, :, np.newaxis] + offsets[:, np.newaxis] * outward[:, np.newaxis, np.newaxis]
    right, down = np.moveaxis(points.reshape(4 * _PROFILES, _SAMPLES, 2).astype(np.float32), 2, 0)
    profiles = cv2.remap(grey, right, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    # Falling brightness belongs to objects beyond the white margin.
    rises = np.maximum(0.0, np.diff(profiles.reshape(4, _PROFILES, _SAMPLES).astype(np.float64)))
    middles = (offsets[1:] + offsets[:-1]) / 2
    steps = rises @ middles / np.maximum(rises.sum(axis=2), 1e-9)
    slopes, at_start = np.polyfit(fractions, steps.T, 1)
    starts = corners + at_start[:, np.newaxis] * outward
    return starts, corners + along + (at_start + slopes)[:, np.newaxis] * outward


def _meeting(starts: NDArray[np.float64], ends: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the intersection of each side (4, 2) with the side before it."""
    # With complex numbers the cross product is the imaginary part of one times the other's
    # conjugate.
    start = starts @ (1.0, 1j)
    along = (ends - starts) @ (1.0, 1j)
    before = np.roll(start, 1)
    along_before = np.roll(along, 1)
    share = ((start - before).conj() * along).imag / (along_before.conj() * along).imag
    meets = before + share * along_before
    return np.column_stack([meets.real, meets.imag])
