"""Drawing on pictures: sheets, rectangles, lines of text, strong colours."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import cv2
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from services.simulator.world.place import Rgb

Picture = NDArray[np.uint8]
#: Width and height of a face's picture, pixels.
SIZE: Final = 512
STRONG: Final[tuple[Rgb, ...]] = (
    (196, 52, 44), (28, 84, 150), (236, 172, 40), (36, 122, 84), (104, 62, 130), (226, 108, 44), (32, 142, 160),
    (170, 40, 92),
)  # fmt: skip
PAPER: Final = (240, 238, 230)
INK: Final = (52, 54, 60)


def sheet(colour: Rgb) -> Picture:
    """Return a picture of one colour."""
    return np.full((SIZE, SIZE, 3), colour, dtype=np.uint8)


def pick(rng: np.random.Generator) -> Rgb:
    """Return one of the strong colours."""
    return STRONG[int(rng.integers(len(STRONG)))]


def fill(picture: Picture, box: tuple[int, int, int, int], colour: Rgb) -> None:
    """Fill a rectangle, given its left, top, width and height."""
    left, top, width, height = box
    cv2.rectangle(picture, (left, top), (left + width - 1, top + height - 1), colour, -1)


def lines(picture: Picture, box: tuple[int, int, int, int], count: int, colour: Rgb, thick: int) -> None:
    """Draw lines of text as bars, the last one shorter."""
    left, top, width, height = box
    for row in range(count):
        across = width if row < count - 1 else width * 3 // 5
        fill(picture, (left, top + row * height // count, across, thick), colour)
