"""Pictures of faces: posters, windows, doors, whiteboards, books, drawers, cartons."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import cv2
import numpy as np
from numpy.typing import ArrayLike

from services.simulator.scene.textures import Picture, as_picture, coloured, layered, noise
from services.simulator.tables import table
from services.simulator.world.place import Rgb

SIZE: Final = 512  # Width and height of a face's picture, pixels.
STRONG: Final[tuple[Rgb, ...]] = (
    (196, 52, 44), (28, 84, 150), (236, 172, 40), (36, 122, 84), (104, 62, 130), (226, 108, 44), (32, 142, 160),
    (170, 40, 92),
)  # fmt: skip
PAPER: Final = (240, 238, 230)
INK: Final = (52, 54, 60)
FacePainter = Callable[[np.random.Generator, Rgb | None], Picture]


@dataclass(frozen=True)
class Face:
    """An entry of the table `faces`."""

    colours: list[Rgb]
    grain_px: tuple[float, float]
    contrast: float
    bars: list[tuple[int, int, int, int, Rgb, int]]

    def paint(self, rng: np.random.Generator, colour: Rgb | None) -> Picture:
        """Return the painted face."""
        plain = colour or self.colours[int(rng.integers(len(self.colours)))]
        picture = coloured(plain, 1.0 + self.contrast * noise(rng, (SIZE, SIZE), self.grain_px))
        for left, top, width, height, tint, outline in self.bars:
            fill(picture, (left, top, width, height), tint, outline or -1)
        return picture


def sheet(colour: Rgb) -> Picture:
    """Return a picture of one colour."""
    return np.full((SIZE, SIZE, 3), colour, dtype=np.uint8)


def pick(rng: np.random.Generator) -> Rgb:
    """Draw a strong colour."""
    return STRONG[int(rng.integers(len(STRONG)))]


def fill(
    picture: Picture, box: tuple[int, int, int, int], colour: tuple[int, ...], outline: int = -1
) -> None:
    """Fill a rectangle (left, top, width, height), or draw its outline if a width is given."""
    left, top, width, height = box
    cv2.rectangle(picture, (left, top), (left + width - 1, top + height - 1), colour, outline)


def lines(
    picture: Picture, box: tuple[int, int, int, int], count: int, colour: Rgb, thick: int
) -> None:
    """Draw lines of text as bars, the last one shorter."""
    left, top, width, height = box
    for row in range(count):
        across = width if row < count - 1 else width * 3 // 5
        fill(picture, (left, top + row * height // count, across, thick), colour)


def paint_face(face: str, variant: int, colour: Rgb | None) -> Picture:
    """Paint a face, (512, 512, 3) uint8 RGB; equal arguments give equal pictures."""
    return FACES[face](np.random.default_rng([sum(face.encode()), variant]), colour)


def _whiteboard(rng: np.random.Generator, colour: Rgb | None) -> Picture:
    picture = coloured(
        colour or (244, 245, 244), 1.0 + 0.01 * layered(rng, (SIZE, SIZE), (3.0, 90.0))
    )
    pens = ((36, 62, 140), (170, 40, 40), (40, 40, 44), (30, 110, 60))
    centres = np.stack([rng.integers(50, 300, 5), rng.integers(70, 440, 5)], axis=1).tolist()
    for first, second in pairwise(centres):
        cv2.arrowedLine(picture, first, second, pens[2], 3, cv2.LINE_AA, tipLength=0.1)
    for number, (x, y) in enumerate(centres):
        fill(picture, (x - 34, y - 24, 68, 48), (244, 245, 244))
        fill(picture, (x - 34, y - 24, 68, 48), pens[number % 4], 3)
    for row in range(10):
        words = np.stack(
            [np.linspace(350, rng.integers(420, 490), 40), 90 + 36 * row + rng.normal(0, 5, 40)],
            axis=1,
        )
        cv2.polylines(picture, [words.astype(np.int32)], False, pens[row % 4], 2, cv2.LINE_AA)
    fill(picture, (0, 0, SIZE, SIZE), (150, 154, 158), 14)
    return picture


def _window(rng: np.random.Generator, colour: Rgb | None) -> Picture:
    picture = _fading((176, 206, 236), (232, 240, 244), 8 * noise(rng, (SIZE, SIZE), (30.0, 90.0)))
    for depth, tint in enumerate(((150, 172, 150), (110, 140, 104))):
        _ridge(picture, 330 + 60 * depth + 18 * layered(rng, (1, SIZE), (16.0, 60.0))[0], tint)
    frame = colour or (224, 224, 220)
    fill(picture, (0, 0, SIZE, SIZE), frame, 44)
    fill(picture, (SIZE // 2 - 20, 0, 40, SIZE), frame)
    for left in (22, SIZE // 2 + 20):
        fill(picture, (left, 22, 215, SIZE - 44), (170, 172, 172), 3)
    fill(picture, (SIZE // 2 - 12, 240, 24, 60), (150, 152, 156))
    return picture


def _fading(top: ArrayLike, low: ArrayLike, more: ArrayLike = 0.0) -> Picture:
    """Paint a vertical gradient between two colours; `more` is added to each pixel."""
    fade = np.linspace(0, 1, SIZE)[:, None, None]
    sky = np.asarray(top) * (1 - fade) + np.asarray(low) * fade
    return as_picture(
        np.broadcast_to(sky, (SIZE, SIZE, 3)) + np.broadcast_to(more, (SIZE, SIZE))[..., None]
    )


def _ridge(picture: Picture, tops: ArrayLike, tint: ArrayLike) -> None:
    """Paint the area below a line of heights (512,), pixels from above."""
    below = np.array([*enumerate(np.asarray(tops)), (SIZE, SIZE), (0, SIZE)]).astype(np.int32)
    cv2.fillPoly(picture, [below], np.clip(tint, 0, 255).tolist(), cv2.LINE_AA)


def _books(rng: np.random.Generator, colour: Rgb | None) -> Picture:
    picture = sheet((58, 48, 40))
    left = 6
    while left < SIZE - 20:
        width = int(rng.integers(14, 46))
        height = int(rng.uniform(0.62, 0.93) * SIZE)
        if rng.random() < 0.12:
            left += int(rng.integers(20, 70))
            continue
        width = min(width, SIZE - 6 - left)
        back = np.array(colour or pick(rng)) * rng.uniform(0.55, 1.1) + rng.uniform(0, 40)
        shade = np.sin(np.linspace(0.35, 2.6, width))[None, :, None]
        picture[SIZE - height :, left : left + width] = as_picture(
            back * shade * np.ones((height, 1, 1))
        )
        for band in (0.12, 0.2, 0.8):
            fill(
                picture,
                (left + 2, SIZE - height + int(band * height), width - 4, 7),
                (222, 210, 170),
            )
        left += width + 1
    return picture


def paint_poster(rng: np.random.Generator, colour: Rgb | None) -> Picture:
    """Paint a poster of one of four kinds: conference, landscape, circles, sign."""
    kinds = (_paper_poster, _landscape, _circles, _sign)
    accent = colour or pick(rng)
    picture = kinds[int(rng.integers(len(kinds)))](rng, accent)
    fill(picture, (0, 0, SIZE, SIZE), (226, 226, 222), 8)
    return picture


def _paper_poster(rng: np.random.Generator, accent: Rgb) -> Picture:
    picture = sheet(PAPER)
    fill(picture, (0, 0, SIZE, 92), accent)
    lines(picture, (40, 26, 400, 44), 2, (248, 246, 240), 12)
    for left in (24, 184, 344):
        for top in range(112, 470, 96):
            if rng.random() < 0.5:
                fill(picture, (left, top, 144, 84), (224, 228, 232))
                for bar, tall in enumerate(rng.integers(10, 76, 6).tolist()):
                    fill(picture, (left + 8 + bar * 22, top + 84 - tall, 16, tall), pick(rng))
            else:
                fill(picture, (left, top, int(rng.integers(50, 120)), 10), accent)
                lines(picture, (left, top + 18, 144, 70), 6, (130, 130, 132), 4)
    return picture


def _landscape(rng: np.random.Generator, accent: Rgb) -> Picture:
    picture = _fading(np.array(pick(rng)) * 0.6 + 90, (250, 226, 190))
    cv2.circle(
        picture, rng.integers(110, [400, 220]).tolist(), 52, (252, 240, 200), -1, cv2.LINE_AA
    )
    for depth in range(4):
        ridge = 230 + 62 * depth + 46 * layered(rng, (1, SIZE), (24.0, 90.0 + 20 * depth))[0]
        _ridge(picture, ridge, np.array(accent) * (0.45 + 0.15 * depth) + 90 * (1 - depth / 3))
    lines(picture, (60, 452, 390, 40), 2, (246, 244, 236), 10)
    return picture


def _circles(rng: np.random.Generator, accent: Rgb) -> Picture:
    colours = [accent, pick(rng), INK, (238, 230, 212)]
    picture = sheet(colours[-1])
    for left, top in np.ndindex(4, 4):
        cell = np.full((128, 128, 3), colours[int(rng.choice([0, 1, 2, 3, 3, 3]))], dtype=np.uint8)
        centre = (128 * rng.integers(2, size=2)).tolist()
        for radius in (128, 60):
            cv2.circle(cell, centre, radius, colours[int(rng.integers(4))], -1, cv2.LINE_AA)
        picture[128 * top : 128 * top + 128, 128 * left : 128 * left + 128] = cell
    return picture


def _sign(rng: np.random.Generator, accent: Rgb) -> Picture:
    picture = sheet(PAPER)
    fill(picture, (0, 0, SIZE, 340), accent)
    turn = np.linspace(0, 2 * np.pi, int(rng.integers(3, 7)), endpoint=False) - np.pi / 2
    corners = [
        np.stack([256 + 140 * np.cos(turn), 178 + 140 * np.sin(turn)], axis=1).astype(np.int32)
    ]
    cv2.fillPoly(picture, corners, (250, 248, 240), cv2.LINE_AA)
    fill(picture, (240, 110, 32, 90), INK)
    cv2.circle(picture, (256, 226), 18, INK, -1, cv2.LINE_AA)
    lines(picture, (50, 370, 412, 120), 4, INK, 14)
    return picture


#: Painters by the name of the face.
FACES: Final[dict[str, FacePainter]] = {
    "books": _books, "poster": paint_poster, "whiteboard": _whiteboard, "window": _window,
    **{name: face.paint for name, face in table("faces", dict[str, Face]).items()},
}  # fmt: skip
