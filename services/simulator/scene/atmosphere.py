"""What lies between the world and the picture: haze in the air, and the camera's exposure."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Final

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

# Koschmieder: at the visibility, 5 % of the contrast is left.
_CONTRAST_AT_VISIBILITY: Final = 0.05


def hazy(
    image: NDArray[np.uint8], depth_m: NDArray[np.float32], visibility_m: float, colour: tuple[float, float, float]
) -> NDArray[np.uint8]:
    """Return an image seen through haze (Koschmieder's law).

    Parameters
    ----------
    image
        (h, w, 3) uint8 RGB in clear air.
    depth_m
        (h, w) distance of every pixel, metres; infinity for the sky.
    visibility_m
        Distance at which 5 % of the contrast is left, above 0.
    colour
        Of the haze, 0 to 255.
    """
    through = np.exp(depth_m * np.float32(np.log(_CONTRAST_AT_VISIBILITY) / visibility_m))[..., None]
    veiled = image * through + np.asarray(colour, dtype=np.float32) * (1 - through)
    return np.asarray(np.rint(veiled), dtype=np.uint8)


def exposed(image: NDArray[np.uint8], stops: float) -> NDArray[np.uint8]:
    """Return an sRGB image exposed `stops` more, burnt out or drowned in black as a camera's would be."""
    return np.asarray(cv2.LUT(image, _curve(stops)), dtype=np.uint8)


@lru_cache(maxsize=16)
def _curve(stops: float) -> NDArray[np.uint8]:
    """Return the 256 new values: to linear light, brighter, and back (IEC 61966-2-1)."""
    encoded = np.arange(256) / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    brighter = np.clip(linear * 2.0**stops, 0, 1)
    again = np.where(brighter <= 0.0031308, brighter * 12.92, 1.055 * brighter ** (1 / 2.4) - 0.055)
    return np.asarray(np.rint(255 * again), dtype=np.uint8)
