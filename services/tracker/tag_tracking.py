"""Ground truth as in the paper's indoor experiment: the pose of a tag from an overhead camera.

The tag lies flat at a known height and the camera looks straight down. Therefore the image is a
scaled map of the tag's plane, and the pose is planar.
"""

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.camera import Calibration
from services.tracker.tag_detection import find_markers

#: Maximum root mean square error of the corners, as a share of the side: the error when a single
#: corner is so far off that it turns the heading by 2 degrees.
MAX_ERROR: Final = 0.035
#: Relative deviation from the tag's size beyond which the size is wrong, rather than the shape.
MAX_SIDE_DEVIATION: Final = 0.1


class TagNotSeen(Exception):  # noqa: N818 - an event rather than an error
    """The pose is unknown; the text gives the reason in one line."""


@dataclass(frozen=True)
class Tag:
    """Square ArUco marker of ``DICT_4X4_50``, flat on the robot with its upper edge ahead."""

    number: int
    side_m: float
    height_m: float


class TagPose(NamedTuple):
    """Pose of the tag: metres east and north, heading in radians counter-clockwise from east.

    The heading is in [-pi, pi].
    """

    x_m: float
    y_m: float
    heading_rad: float
    # Root mean square reprojection error of the tag's corners.
    error_px: float


def locate(tag: Tag, image: NDArray[np.uint8], camera: Calibration) -> TagPose:
    """Return the pose of a tag in an RGB image (height, width, 3).

    Raises
    ------
    ValueError
        If the camera is not above the tag.
    TagNotSeen
        If the tag is missing, not unique, or not a square of its size.
    """
    if camera.height_m <= tag.height_m:
        above = f"a camera {camera.height_m:g} m above the floor"
        raise ValueError(f"{above} cannot look down on a tag at {tag.height_m:g} m")
    metres_per_px = (camera.height_m - tag.height_m) / camera.focal_px
    found = find_markers(image, tag.number)
    if len(found) != 1:
        raise TagNotSeen(f"{len(found) or 'no'} markers with number {tag.number} are in the image")
    corners = _onto_plane(found[0], camera, metres_per_px)
    side_m = float(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).mean())
    if abs(side_m - tag.side_m) > MAX_SIDE_DEVIATION * tag.side_m:
        raise TagNotSeen(
            f"marker {tag.number} measures {side_m:.3f} m instead of {tag.side_m:g} m; "
            "check the tag, its height and the calibration"
        )
    x_m, y_m, heading_rad, error_m = fit_square(corners, tag.side_m)
    error_px = error_m / metres_per_px
    most_px = MAX_ERROR * tag.side_m / metres_per_px
    # Not `>`: the error is NaN if the corners could not be computed.
    if not error_px <= most_px:
        raise TagNotSeen(
            f"marker {tag.number} is not a square of {tag.side_m:g} m: "
            f"corner error too large ({error_px:.2f} px > maximum {most_px:.2f} px)"
        )
    return TagPose(x_m, y_m, heading_rad, error_px)


def _onto_plane(
    pixels: NDArray[np.float64], camera: Calibration, metres_per_px: float
) -> NDArray[np.float64]:
    """Project pixels (n, 2) onto a horizontal plane of a scale: metres east and north."""
    right, down = ((pixels - (camera.centre_x_px, camera.centre_y_px)) * metres_per_px).T
    cos = math.cos(camera.up_rad)
    sin = math.sin(camera.up_rad)
    return np.column_stack(
        [camera.x_m + right * sin - down * cos, camera.y_m - right * cos - down * sin]
    )


def fit_square(corners: NDArray[np.float64], side: float) -> tuple[float, float, float, float]:
    """Fit a square of known side to four points by least squares, in closed form (Kabsch).

    Parameters
    ----------
    corners
        Points (4, 2), seen from above, clockwise from the one ahead on the left.
    side
        Side of the square, in the same unit.

    Returns
    -------
    tuple of float
        x and y of the square's centre, its direction in [-pi, pi], and the root mean square
        distance of the corners.
    """
    ahead_left = side / 2 * np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]])
    middle = corners.mean(axis=0)
    # With complex numbers a rotation is a product, and the best rotation is the direction of the
    # correlation.
    model = ahead_left @ (1.0, 1j)
    measured = (corners - middle) @ (1.0, 1j)
    turn = np.vdot(model, measured)
    heading = float(np.angle(turn))
    error = float(np.sqrt(np.mean(np.abs(measured - model * np.exp(1j * heading)) ** 2)))
    return float(middle[0]), float(middle[1]), heading, error
