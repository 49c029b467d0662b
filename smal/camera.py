"""Camera models, and virtual views: images warped to a pose beside or turned from the pose of the camera.

A wide lens distorts the image. Calibrations name the models of OpenCV and ROS. An
uncalibrated camera is modelled as rectilinear (straight lines stay straight) or equidistant
(fisheye), the model that predicts views better.

One drive shows every place from one pose. A robot that drifts sees it from other poses, for each of which the paper
needs a demonstration. We warp the taught image instead. A pure turn is exact for every scene. A step needs distances,
and we take the simplest scene that has any: flat ground under the camera, and everything above it at one distance.
`smal.teaching.calibration` fits the camera, its height and the distance, so that taught views predict others of the
same drive best. Nothing has to be measured by hand.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Final, Literal, Self, get_args

import numpy as np

from smal.arrays import AnyArray, Floats, Uint8s

Image = Uint8s  # RGB, uint8 (height, width, 3).
#: Turns of virtual views. 5 degrees are about a sixteenth of the image, the width of a HOG cell,
#: within which a view hardly changes. Beyond 40 degrees hardly anything of the taught image is left.
TURNS_DEG: Final = 5.0 * np.arange(-8, 9)
#: Spacing of the turns.
STEP_DEG: Final = float(TURNS_DEG[1] - TURNS_DEG[0])
#: Index of the view that is not turned.
STRAIGHT: Final = TURNS_DEG.size // 2
Maps = tuple[AnyArray, AnyArray]

Lens = Literal["plumb_bob", "rational_polynomial", "equidistant"]
#: Largest angle from the axis. A rectilinear lens sees less than a right angle.
_MOST_RAD: Final = {
    "plumb_bob": math.radians(89.0),
    "rational_polynomial": math.radians(89.0),
    "equidistant": math.pi,
}
#: Limits of the focal length over the width of the image: fields of view from 170 to 5 degrees.
_LEAST_FOCAL = 0.04
_MOST_FOCAL = 12.0
_MOST_DISTORTION: Final = 1e6
#: Field of view from which an uncalibrated lens is equidistant: rectilinear lenses end before.
_WIDE_DEG: Final = 125.0
#: Largest height of a camera and distance of a scene.
_MOST_AWAY: Final = 1e6


@dataclass(frozen=True)
class Camera:
    """A level camera; ValueError if no camera has these values."""

    #: Focal length over the image's width, 0.04 to 12, equal across and down.
    focal: float
    #: A model of OpenCV and ROS; "plumb_bob" without distortion is rectilinear.
    lens: Lens = "plumb_bob"
    #: Coefficients in the order of ROS: k1, k2, p1, p2, k3 to k6, or k1 to k4 of "equidistant"; missing ones are 0. The
    #: tangential ones (p1, p2) are ignored.
    distortion: tuple[float, ...] = ()
    #: Principal point, right of and below the middle of the image, over the image's width; -0.5 to 0.5.
    centre: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if not _LEAST_FOCAL <= self.focal <= _MOST_FOCAL:
            raise ValueError(
                f"no camera has a focal length of {self.focal:g} times the width of its image"
            )
        if self.lens not in get_args(Lens):
            raise ValueError(
                f"the lens must be one of {', '.join(get_args(Lens))}, got {str(self.lens)[:80]!r}"
            )
        moderate = all(abs(coefficient) <= _MOST_DISTORTION for coefficient in self.distortion)
        if len(self.distortion) > 8 or not moderate:
            raise ValueError(
                f"distortion must be at most 8 numbers of -{_MOST_DISTORTION:g} to {_MOST_DISTORTION:g}"
            )
        if not all(abs(offset) <= 0.5 for offset in self.centre):
            raise ValueError("the axis of a camera must meet its image")

    @classmethod
    def of_field(cls, field_deg: float, lens: Lens | None = None) -> "Camera":
        """Return the camera without distortion that has a horizontal field of view, in degrees.

        Without a lens model, a field from 125 degrees on is equidistant.
        """
        if lens is None:
            lens = "equidistant" if field_deg >= _WIDE_DEG else "plumb_bob"
        half = math.radians(field_deg) / 2.0
        if not 0.0 < half < _MOST_RAD[lens]:
            most = 2.0 * math.degrees(_MOST_RAD[lens])
            raise ValueError(
                f"the field of view of the lens {lens} must be above 0 and below {most:g} degrees, "
                f"got {field_deg:g}"
            )
        radius = half if lens == "equidistant" else math.tan(half)
        return cls(0.5 / radius, lens)

    @property
    def field_deg(self) -> float:
        """Horizontal field of view, degrees."""
        half = float(self.angle(0.5 / self.focal))
        return 2.0 * math.degrees(half)

    def radius(self, angle_rad: AnyArray) -> Floats:
        """Return the distance from the principal point at an angle from the axis, in focal lengths."""
        angles, radii = self._table
        # The angles are evenly spaced: `np.interp` searches them and takes four times as long.
        at = np.clip(np.asarray(angle_rad) / angles[1], 0.0, len(angles) - 1)
        below = np.minimum(at.astype(np.intp), len(angles) - 2)
        slope = radii[below + 1] - radii[below]
        return np.asarray(radii[below] + (at - below) * slope)

    def magnification(self, off: Floats, ahead: Floats) -> Floats:
        """Return the distance from the principal point, in focal lengths, over the distance `off` from the axis.

        Points far outside of the image, or behind the camera, come to lie at its border.
        """
        if self.lens == "plumb_bob" and not any(self.distortion):
            # The table gives the same in twice the time.
            return np.asarray(1.0 / np.maximum(ahead, off / math.tan(_MOST_RAD[self.lens])))
        return np.minimum(self.radius(np.arctan2(off, ahead)), 100.0) / off

    def angle(self, radius: AnyArray | float) -> Floats:
        """Return the angle from the axis at a distance from the principal point, the inverse of `radius`."""
        angles, radii = self._table
        return np.asarray(np.interp(radius, radii, angles))

    def middle(self, shape: tuple[int, ...]) -> tuple[float, float]:
        """Return the column and the row of the principal point in an image of this shape (rows, columns)."""
        rows, columns = shape
        right, down = self.centre
        column = (columns - 1) / 2.0 + columns * right
        row = (rows - 1) / 2.0 + columns * down
        return column, row

    @lru_cache(maxsize=8)  # noqa: B019 - a camera is a value: a fit needs the same rays hundreds of times
    def rays(
        self, shape: tuple[int, ...], aspect: float | None = None
    ) -> tuple[Floats, Floats, Floats]:
        """Return the direction of each pixel of an image of this shape: right, down, ahead, of unit length.

        An image that was stretched to this shape had another `aspect`, its height over its width.
        """
        rows, columns = shape
        right_of, below = self.centre
        v, u = np.mgrid[0:rows, 0:columns]
        height = rows / columns if aspect is None else aspect
        across = ((u - (columns - 1) / 2.0) / columns - right_of) / self.focal
        down = ((v - (rows - 1) / 2.0) / rows * height - below) / self.focal
        out = np.maximum(np.hypot(across, down), 1e-9)
        angle = self.angle(out)
        sin = np.sin(angle)
        return sin * across / out, sin * down / out, np.cos(angle)

    @cached_property
    def _table(self) -> tuple[Floats, Floats]:
        """Angles and distances from the principal point, up to the largest angle where the distance still grows."""
        angles = np.linspace(0.0, _MOST_RAD[self.lens], 2**14)
        k = np.zeros(8)
        k[: len(self.distortion)] = self.distortion
        if self.lens == "equidistant":
            radii = angles * np.polynomial.Polynomial([1.0, *k[:4]])(angles**2)
        else:
            x = np.tan(angles)
            squared = x**2
            above = np.polynomial.Polynomial([1.0, k[0], k[1], k[4]])(squared)
            below = np.polynomial.Polynomial([1.0, *k[5:]])(squared)
            radii = x * above / below
        falls = np.flatnonzero(~(np.diff(radii) > 0.0))
        end = falls[0] + 1 if falls.size else len(angles)
        return angles[:end], radii[:end]


@dataclass(frozen=True)
class Scene:
    """A camera over flat ground, inside a cylindrical wall; ValueError if no scene has these values.

    Height and distance are above 0, in one unit.
    """

    camera: Camera
    height: float
    distance: float

    def __post_init__(self) -> None:
        if not (0.0 < self.height <= _MOST_AWAY and 0.0 < self.distance <= _MOST_AWAY):
            raise ValueError(
                f"the height of a camera and the distance of its scene must be above 0, at most "
                f"{_MOST_AWAY:g}, got {self.height!r:.40} and {self.distance!r:.40}"
            )

    @classmethod
    def of_content(cls, content: dict[str, Any]) -> Self:
        """Build the scene from its `dataclasses.asdict` in a file."""
        camera = content["camera"]
        lists = {name: tuple(camera[name]) for name in ("distortion", "centre")}
        return cls(**content | {"camera": Camera(**camera | lists)})

    def warp(
        self, image: Image, step: Sequence[float], view: tuple[int, int] | None = None
    ) -> Image:
        """Return the view from a pose beside the camera.

        Parameters
        ----------
        image : array (height, width, 3)
        step, view
            As in `maps`.
        """
        return remapped(image, self.maps(image.shape[:2], step, view))

    def maps(
        self,
        shape: tuple[int, ...],
        step: Sequence[float],
        view: tuple[int, int] | None = None,
        pitch_rad: float = 0.0,
    ) -> Maps:
        """Return the position of each pixel of a view in an image of this shape, for `remapped`.

        Parameters
        ----------
        shape : (int, int)
            Rows and columns of the image.
        step : sequence of float
            Pose of the view from the camera: ahead, left, and turned left in radians.
        view : (int, int), optional
            Rows and columns of the view; by default those of the image.
        pitch_rad : float
            Angle by which the camera of the image points down. The view is level.
        """
        import cv2  # noqa: PLC0415 - processes that only read models have no OpenCV

        focal = self.camera.focal * shape[1]
        middle_u, middle_v = self.camera.middle(shape)
        x, y, z = self.camera.rays(view or shape)
        ahead, left, turn_rad = step
        cos = math.cos(turn_rad)
        sin = math.sin(turn_rad)
        # The ray of each pixel, in axes of the camera that took the image.
        right = cos * x - sin * z
        deep = sin * x + cos * z
        # Distance along the ray to the ground or the wall, whichever is nearer.
        # Roots of sums of squares: `np.hypot` takes four times as long.
        across = np.sqrt(right * right + deep * deep)
        reach = 1.0 / np.maximum(y / self.height, across / self.distance)
        x = reach * right - left
        y = reach * y
        z = reach * deep + ahead
        if pitch_rad:
            y, z = _pitched(y, z, pitch_rad)
        off = np.maximum(np.sqrt(x * x + y * y), 1e-9)
        scale = self.camera.magnification(off, z) * focal
        columns = (scale * x + middle_u).astype(np.float32)
        rows = (scale * y + middle_v).astype(np.float32)
        return cv2.convertMaps(columns, rows, cv2.CV_16SC2)


def _pitched(down: Floats, ahead: Floats, pitch_rad: float) -> tuple[Floats, Floats]:
    """Return points, down and ahead of a level camera, for a camera that points down by an angle."""
    cos = math.cos(pitch_rad)
    sin = math.sin(pitch_rad)
    return cos * down - sin * ahead, sin * down + cos * ahead


def remapped(image: Image, maps: Maps) -> Image:
    """Return another view of an image (height, width, 3); the maps are computed once for many images."""
    import cv2  # noqa: PLC0415 - see above

    columns, rows = maps
    view = cv2.remap(image, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(view, dtype=np.uint8)
