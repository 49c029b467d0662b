"""Visual compass: the turn of a robot between two images, by the shift of their columns.

A turn shifts the whole view; a way ahead moves its left and right parts apart, which leaves the mean shift nearly
unchanged (RatSLAM, Milford and Wyeth 2008, section IV-B, compares profiles of the columns). Images are centred
first: what stands in every image, such as the robot's own bumper, does not move and would hide the shift. For a robot
without odometry, this replaces the turn that its motors usually make.
"""

import math
from typing import Final

import numpy as np

from smal.arrays import Float32s
from smal.features.color import COLUMNS, ROWS
from smal.features.settings import FeatureSettings

#: Least correlation of the images at the best shift. Below, more than half of the variance changed otherwise than by
#: a shift: the robot was carried, the camera was covered, or the turn was beyond the common part of the images.
_LEAST: Final = 0.5
#: Greatest shift, columns: half of each image must be common.
_REACH: Final = COLUMNS // 2


def picture_of(centred: Float32s, settings: FeatureSettings) -> Float32s:
    """Return the picture that the compass compares, (24, 32, 3).

    Parameters
    ----------
    centred : array (m,)
        Centred features (`Centering.apply`).
    settings : FeatureSettings
        Modalities of the features, with colour.
    """
    where = settings.slices[settings.modalities.index("color")]
    return centred[where].reshape(ROWS, COLUMNS, 3)


def shift_between(before: Float32s, after: Float32s) -> float | None:
    """Return the shift of the view to the right, as a share of the image's width; None if it is unknown.

    A robot that turns to the left sees its view shift to the right. The turn is the shift times the field of view:
    exactly for an equidistant lens, within 5 % for a rectilinear lens of 75 degrees.

    Parameters
    ----------
    before, after : array (24, 32, 3)
        From `picture_of`.
    """
    shifts = range(-_REACH, _REACH + 1)
    alike = np.array([_correlation(before, after, shift) for shift in shifts])
    best = int(alike.argmax())
    if alike[best] < _LEAST or not 0 < best < alike.size - 1:
        return None
    left, middle, right = alike[best - 1 : best + 2]
    # The vertex of the parabola through the maximum and its neighbours.
    bend = left - 2.0 * middle + right
    between = 0.5 * (left - right) / bend if bend < 0.0 else 0.0
    return float(best - _REACH + between) / COLUMNS


def _correlation(before: Float32s, after: Float32s, shift: int) -> float:
    """Return the correlation of the common part of two pictures, -1 to 1."""
    first = before[:, max(-shift, 0) : COLUMNS - max(shift, 0)]
    second = after[:, max(shift, 0) : COLUMNS + min(shift, 0)]
    norm = math.sqrt(float(np.vdot(first, first)) * float(np.vdot(second, second)))
    return float(np.vdot(first, second)) / norm if norm > 0.0 else 0.0
