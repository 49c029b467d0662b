"""How a camera sees, and views from where nobody drove: how it would have seen what it saw from aside, or turned.

A wide lens bends what it sees. Calibrations name the models of OpenCV and ROS. A camera that nobody has calibrated is
taken to be rectilinear (what is straight stays straight) or equidistant (fisheye), whichever predicts views better.

One drive shows every place from one pose. A robot that drifts sees it from others, for each of which the paper needs a
demonstration. We warp the taught image instead. A pure turn is exact whatever the scene is. For a step we need
distances, and take the simplest scene that has any: flat ground under the camera, and everything above it at one
distance. Camera, height and distance are those by which views that were taught predict others of the same drive best
(`smal.teaching.calibration`), so that nobody has to measure them.
"""

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]  # RGB, uint8 (height, width, 3).
#: Turns of virtual views; how far apart they are; and which of them is not turned. 5 degrees are about twenty pixels,
#: the width of a cell of HOG, within which a view stays alike; beyond 40 hardly anything of the taught image is left.
TURNS_DEG: Final = 5.0 * np.arange(-8, 9)
STEP_DEG: Final = float(TURNS_DEG[1] - TURNS_DEG[0])
STRAIGHT: Final = TURNS_DEG.size // 2
Maps = tuple[NDArray[Any], NDArray[Any]]

Lens = Literal["plumb_bob", "rational_polynomial", "equidistant"]
#: What a rectilinear lens sees is less than a right angle from its axis.
_MOST_RAD: Final = {
    "plumb_bob": math.radians(89.0),
    "rational_polynomial": math.radians(89.0),
    "equidistant": math.pi,
}
#: Of fields of view from 170 to 5 degrees, over the width of the image.
_LEAST_FOCAL = 0.04
_MOST_FOCAL = 12.0
_MOST_DISTORTION: Final = 1e6


@dataclass(frozen=True)
class Camera:
    """A camera that looks level, and as far to the left as to the right; ValueError says why no camera sees so."""

    focal: float  # Focal length over the image's width, 0.04 to 12; the same across and down.
    lens: Lens = (
        "plumb_bob"  # A model of OpenCV and ROS; without distortion this one is rectilinear.
    )
    #: Its coefficients in the order of ROS: k1, k2, p1, p2, k3 to k6, or k1 to k4 of "equidistant"; those that are left
    #: out are 0. A lens that is not centred on its sensor (p1, p2) is taken to be.
    distortion: tuple[float, ...] = ()
    #: Where the axis meets the image, right of and below its middle, over the image's width; -0.5 to 0.5.
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
        if len(self.distortion) > 8 or not all(
            abs(one) <= _MOST_DISTORTION for one in self.distortion
        ):
            raise ValueError(
                f"distortion must be at most 8 numbers of -{_MOST_DISTORTION:g} to {_MOST_DISTORTION:g}"
            )
        if not all(abs(one) <= 0.5 for one in self.centre):
            raise ValueError("the axis of a camera must meet its image")

    @classmethod
    def of_field(cls, field_deg: float, lens: Lens = "plumb_bob") -> "Camera":
        """Return the camera without distortion that sees so far from the left to the right, in degrees."""
        half = math.radians(field_deg) / 2.0
        return cls(0.5 / (half if lens == "equidistant" else math.tan(half)), lens)

    @property
    def field_deg(self) -> float:
        """How far it sees from the left to the right of its image."""
        return 2.0 * math.degrees(float(self.angle(0.5 / self.focal)))

    def radius(self, angle_rad: NDArray[Any]) -> NDArray[np.float64]:
        """Return how far from the middle it shows what is at an angle from its axis, in focal lengths."""
        angles, radii = self._table
        # Its angles are evenly spaced: `np.interp`, which looks for them, takes four times as long.
        at = np.clip(np.asarray(angle_rad) / angles[1], 0.0, len(angles) - 1)
        below = np.minimum(at.astype(np.intp), len(angles) - 2)
        return np.asarray(radii[below] + (at - below) * (radii[below + 1] - radii[below]))

    def angle(self, radius: NDArray[Any] | float) -> NDArray[np.float64]:
        """Return the angle from its axis of what it shows so far from the middle, the opposite of `radius`."""
        angles, radii = self._table
        return np.asarray(np.interp(radius, radii, angles))

    def middle(self, shape: tuple[int, ...]) -> tuple[float, float]:
        """Return the column and the row at which the axis meets an image of this shape (rows, columns)."""
        rows, columns = shape
        right, down = self.centre
        return (columns - 1) / 2.0 + columns * right, (rows - 1) / 2.0 + columns * down

    @lru_cache(maxsize=8)  # noqa: B019 - a camera is a value: a fit asks for the same rays hundreds of times
    def rays(
        self, shape: tuple[int, ...]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return the direction of each pixel of an image of this shape: right, down, ahead, of length 1."""
        middle_u, middle_v = self.middle(shape)
        focal = self.focal * shape[1]
        v, u = np.mgrid[0 : shape[0], 0 : shape[1]]
        across = (u - middle_u) / focal
        down = (v - middle_v) / focal
        out = np.maximum(np.hypot(across, down), 1e-9)
        angle = self.angle(out)
        return np.sin(angle) * across / out, np.sin(angle) * down / out, np.cos(angle)

    @cached_property
    def _table(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Angles, and how far from the middle they are shown: up to where more angle is no longer further out."""
        angles = np.linspace(0.0, _MOST_RAD[self.lens], 2**14)
        k = np.zeros(8)
        k[: len(self.distortion)] = self.distortion
        if self.lens == "equidistant":
            radii = angles * np.polynomial.Polynomial([1.0, *k[:4]])(angles**2)
        else:
            x = np.tan(angles)
            above = np.polynomial.Polynomial([1.0, k[0], k[1], k[4]])(x**2)
            radii = x * above / np.polynomial.Polynomial([1.0, *k[5:]])(x**2)
        falls = np.flatnonzero(~(np.diff(radii) > 0.0))
        end = falls[0] + 1 if falls.size else len(angles)
        return angles[:end], radii[:end]


@dataclass(frozen=True)
class Scene:
    """A camera over flat ground, before a wall all round: its height, and the distance of all above the ground.

    Both are above 0, in one unit.
    """

    camera: Camera
    height: float
    distance: float

    def warp(
        self, image: Image, ahead: float = 0.0, left: float = 0.0, turn_rad: float = 0.0
    ) -> Image:
        """Return what is seen from ahead and left of where an image (height, width, 3) was taken, and turned left.

        Lengths are in the unit of the scene. What the image does not show repeats its border.
        """
        return remapped(image, self.maps(image.shape[:2], ahead, left, turn_rad))

    def maps(self, shape: tuple[int, ...], ahead: float, left: float, turn_rad: float) -> Maps:
        """Return where each pixel of the other view lies in an image of this shape, for `remapped`."""
        import cv2  # noqa: PLC0415 - processes that only read models have no OpenCV

        focal = self.camera.focal * shape[1]
        middle_u, middle_v = self.camera.middle(shape)
        # Of each pixel, in axes of the camera that took the image.
        x, y, z = self.camera.rays(shape)
        right = math.cos(turn_rad) * x - math.sin(turn_rad) * z
        deep = math.sin(turn_rad) * x + math.cos(turn_rad) * z
        # How far along the ray the ground or the wall is, whichever comes first.
        # Roots of sums of squares: `np.hypot` takes four times as long.
        reach = 1.0 / np.maximum(
            y / self.height, np.sqrt(right * right + deep * deep) / self.distance
        )
        x = reach * right - left
        y = reach * y
        z = reach * deep + ahead
        off = np.maximum(np.sqrt(x * x + y * y), 1e-9)
        # Far outside of the image its border is repeated.
        radius = np.minimum(self.camera.radius(np.arctan2(off, z)), 100.0) * focal / off
        return cv2.convertMaps(
            (radius * x + middle_u).astype(np.float32),
            (radius * y + middle_v).astype(np.float32),
            cv2.CV_16SC2,
        )


def remapped(image: Image, maps: Maps) -> Image:
    """Return another view of an image (height, width, 3); maps are made once for many images (`Scene.maps`)."""
    import cv2  # noqa: PLC0415 - see above

    return np.asarray(
        cv2.remap(image, maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE),
        dtype=np.uint8,
    )
