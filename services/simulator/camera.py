"""The robot's camera: its settings, what it can be asked for, and what air, motion and exposure do to its picture."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from services.simulator.sensors import Tilt
from services.simulator.variation import DAY, Daylight
from services.simulator.world.place import Pose

#: How wide the robot's camera sees.
FIELD_OF_VIEW_DEG: Final = 75.0
# Time over which one picture collects light; what moves meanwhile is blurred.
_EXPOSURE_S: Final = 0.02
# Less than this moves no pixel visibly.
_LEAST_PX: Final = 0.25
# Pixels from one of the averaged pictures to the next: as the pictures are interpolated, no step shows.
_STEP_PX: Final = 1.5
# Koschmieder: at the visibility, 5 % of the contrast is left.
_CONTRAST_AT_VISIBILITY: Final = 0.05


@dataclass(frozen=True)
class CameraSettings:
    """The robot's camera: image size in pixels, shadows of the sun, and in what light."""

    width: int = 1024
    height: int = 768
    shadows: bool = True
    light: Daylight = DAY.light


class Camera(Protocol):
    """The robot's eye, and the one above it; `rendering.SceneCamera` is the real one."""

    @property
    def focal_px(self) -> float:
        """Focal length of the robot's eye in pixels."""

    def render(self, pose: Pose, tilt: Tilt) -> NDArray[np.uint8]:
        """Return the image seen from `pose` by a camera that is tilted there."""

    def depth_m(self, pose: Pose, tilt: Tilt) -> NDArray[np.float32]:
        """Return how far along the optical axis each pixel's surface is, (height, width) metres or `inf`."""

    def victim_pixels(self, pose: Pose, tilt: Tilt) -> float:
        """Return the fraction of the image, 0 to 1, that the victim fills, seen from `pose`."""

    def overhead(self, pose: Pose) -> NDArray[np.uint8]:
        """Return what the camera above the scene, if there is one, sees of a robot at `pose`."""


def blur(image: NDArray[np.uint8], rate: Tilt, focal_px: float) -> NDArray[np.uint8]:
    """Return the image as it is while the camera turns: the mean of its pictures along every pixel's path.

    To the left moves the picture (height, width, 3) to the right, downwards moves it up, and a roll turns it about its
    middle; for angles this small that is the same for everything in view, near or far. Edges are continued outwards;
    where nothing moves visibly, it is the image itself.
    """
    height, width = image.shape[:2]
    turn_rad, down_rad, left_rad = (_EXPOSURE_S * one for one in rate)
    right_px, down_px = focal_px * left_rad, -focal_px * down_rad
    longest_px = math.hypot(right_px, down_px) + abs(turn_rad) * math.hypot(width, height) / 2
    if longest_px < _LEAST_PX:
        return image
    count = math.ceil(longest_px / _STEP_PX) + 1
    total = np.zeros(image.shape, dtype=np.float32)
    for part in (np.arange(count) + 0.5) / count - 0.5:
        affine = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), math.degrees(part * turn_rad), 1.0)
        affine[:, 2] += part * right_px, part * down_px
        moved = cv2.warpAffine(image, affine, (width, height), borderMode=cv2.BORDER_REPLICATE)
        cv2.accumulate(moved, total)
    return np.rint(total / count).astype(np.uint8)


def hazy(
    image: NDArray[np.uint8], depth_m: NDArray[np.float32], visibility_m: float, colour: tuple[float, float, float]
) -> NDArray[np.uint8]:
    """Return an image (h, w, 3) seen through haze of a colour (Koschmieder's law).

    `depth_m` is the distance of every pixel (h, w), infinity for the sky; at `visibility_m` 5 % of the contrast is
    left.
    """
    through = np.exp(depth_m * np.float32(np.log(_CONTRAST_AT_VISIBILITY) / visibility_m))[..., None]
    veiled = image * through + np.asarray(colour, dtype=np.float32) * (1 - through)
    return np.asarray(np.rint(veiled), dtype=np.uint8)


@lru_cache(maxsize=16)
def exposure(stops: float) -> NDArray[np.uint8]:
    """Return the 256 values that those of an sRGB image become when it is exposed `stops` more.

    To linear light, brighter, and back (IEC 61966-2-1): burnt out or drowned in black as a camera's would be.
    """
    encoded = np.arange(256) / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    brighter = np.clip(linear * 2.0**stops, 0, 1)
    again = np.where(brighter <= 0.0031308, brighter * 12.92, 1.055 * brighter ** (1 / 2.4) - 0.055)
    return np.asarray(np.rint(255 * again), dtype=np.uint8)
