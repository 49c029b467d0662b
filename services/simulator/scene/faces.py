"""Pictures that fill one face of something: posters, windows, doors, whiteboards, books, drawers, cartons."""

from collections.abc import Callable
from itertools import pairwise
from typing import Final

import cv2
import numpy as np

from services.simulator.scene.textures import Picture, as_picture, coloured, layered, noise
from services.simulator.world.place import Rgb

#: Width and height of a face's picture, pixels.
SIZE: Final = 512
STRONG: Final[tuple[Rgb, ...]] = (
    (196, 52, 44), (28, 84, 150), (236, 172, 40), (36, 122, 84), (104, 62, 130), (226, 108, 44), (32, 142, 160),
    (170, 40, 92),
)  # fmt: skip
PAPER: Final = (240, 238, 230)
INK: Final = (52, 54, 60)
FacePainter = Callable[[np.random.Generator, Rgb | None], Picture]


def sheet(colour: Rgb) -> Picture:
    """Return a picture of one colour."""
    return np.full((SIZE, SIZE, 3), colour, dtype=np.uint8)


def pick(rng: np.random.Generator) -> Rgb:
    """Return one of the strong colours."""
    return STRONG[int(rng.integers(len(STRONG)))]


def fill(picture: Picture, box: tuple[int, int, int, int], colour: tuple[int, ...]) -> None:
    """Fill a rectangle, given its left, top, width and height."""
    left, top, width, height = box
    cv2.rectangle(picture, (left, top), (left + width - 1, top + height - 1), colour, -1)


def lines(picture: Picture, box: tuple[int, int, int, int], count: int, colour: Rgb, thick: int) -> None:
    """Draw lines of text as bars, the last one shorter."""
    left, top, width, height = box
    for row in range(count):
        across = width if row < count - 1 else width * 3 // 5
        fill(picture, (left, top + row * height // count, across, thick), colour)


def paint_face(face: str, variant: int, colour: Rgb | None) -> Picture:
    """Return the picture of a face, (512, 512, 3) uint8 RGB; equal arguments give equal pictures."""
    return FACES[face](np.random.default_rng([sum(face.encode()), variant]), colour)


def _whiteboard(rng: np.random.Generator, colour: Rgb | None) -> Picture:
    picture = coloured(colour or (244, 245, 244), 1.0 + 0.01 * layered(rng, (SIZE, SIZE), (3.0, 90.0)))
    pens = ((36, 62, 140), (170, 40, 40), (40, 40, 44), (30, 110, 60))
    centres = np.stack([rng.integers(50, 300, 5), rng.integers(70, 440, 5)], axis=1)
    for first, second in pairwise(centres):
        cv2.arrowedLine(picture, first.tolist(), second.tolist(), pens[2], 3, cv2.LINE_AA, tipLength=0.1)
    for number, (x, y) in enumerate(centres):
        cv2.rectangle(picture, (int(x) - 34, int(y) - 24), (int(x) + 34, int(y) + 24), (244, 245, 244), -1)
        cv2.rectangle(picture, (int(x) - 34, int(y) - 24), (int(x) + 34, int(y) + 24), pens[number % 4], 3)
    curve = 200 - 110 * np.exp(-((np.linspace(-2, 2, 60) - rng.uniform(-0.7, 0.7)) ** 2) * 2)
    points = np.stack([np.linspace(360, 480, 60), curve], axis=1).astype(np.int32)
    cv2.polylines(picture, [points], False, pens[1], 4, cv2.LINE_AA)
    for row in range(6):
        words = rng.normal(0, 5, 40)
        scribble = np.stack([np.linspace(350, int(rng.integers(420, 490)), 40), 270 + 32 * row + words], axis=1)
        cv2.polylines(picture, [scribble.astype(np.int32)], False, pens[row % 4], 2, cv2.LINE_AA)
    cv2.rectangle(picture, (0, 0), (SIZE - 1, SIZE - 1), (150, 154, 158), 14)
    return picture


def _window(rng: np.random.Generator, colour: Rgb | None) -> Picture:
    fade = np.linspace(0, 1, SIZE)[:, None, None]
    sky = np.array([176, 206, 236]) * (1 - fade) + np.array([232, 240, 244]) * fade
    picture = as_picture(np.broadcast_to(sky, (SIZE, SIZE, 3)) + 8 * noise(rng, (SIZE, SIZE), (30.0, 90.0))[..., None])
    across = np.arange(SIZE)
    for depth, tint in enumerate(((150, 172, 150), (110, 140, 104))):
        tops = 330 + 60 * depth + 18 * layered(rng, (1, SIZE), (16.0, 60.0))[0]
        outline = np.array([*np.stack([across, tops], axis=1), (SIZE, SIZE), (0, SIZE)]).astype(np.int32)
        cv2.fillPoly(picture, [outline], tint)
    frame = colour or (224, 224, 220)
    cv2.rectangle(picture, (0, 0), (SIZE - 1, SIZE - 1), frame, 44)
    fill(picture, (SIZE // 2 - 20, 0, 40, SIZE), frame)
    for left in (22, SIZE // 2 + 20):
        cv2.rectangle(picture, (left, 22), (left + 214, SIZE - 23), (170, 172, 172), 3)
    fill(picture, (SIZE // 2 - 12, 240, 24, 60), (150, 152, 156))
    return picture


def _door(rng: np.random.Generator, colour: Rgb | None) -> Picture:
    leaf = colour or ((150, 96, 56), (66, 96, 128), (186, 178, 160), (112, 48, 46))[int(rng.integers(4))]
    grain = noise(rng, (SIZE, SIZE), (90.0, 1.5))
    picture = coloured(leaf, 1.0 + 0.04 * grain)
    cv2.rectangle(picture, (0, 0), (SIZE - 1, SIZE + 40), (206, 206, 200), 52)
    cv2.rectangle(picture, (27, 27), (SIZE - 28, SIZE + 40), (60, 58, 56), 4)
    fill(picture, (320, 70, 90, 190), (60, 70, 78))
    cv2.rectangle(picture, (320, 70), (410, 260), (170, 172, 172), 6)
    fill(picture, (62, 258, 60, 10), (188, 190, 194))
    fill(picture, (60, 240, 18, 60), (168, 170, 174))
    fill(picture, (28, 480, SIZE - 56, 32), (160, 162, 166))
    return picture


def _books(rng: np.random.Generator, colour: Rgb | None) -> Picture:
    picture = sheet((58, 48, 40))
    left = 6
    while left < SIZE - 20:
        width, height = int(rng.integers(14, 46)), int(rng.uniform(0.62, 0.93) * SIZE)
        if rng.random() < 0.12:
            left += int(rng.integers(20, 70))
            continue
        width = min(width, SIZE - 6 - left)
        back = np.array(colour or pick(rng)) * rng.uniform(0.55, 1.1) + rng.uniform(0, 40)
        shade = np.sin(np.linspace(0.35, 2.6, width))[None, :, None]
        picture[SIZE - height :, left : left + width] = as_picture(back * shade * np.ones((height, 1, 1)))
        for band in (0.12, 0.2, 0.8):
            fill(picture, (left + 2, SIZE - height + int(band * height), width - 4, 7), (222, 210, 170))
        left += width + 1
    return picture


def _drawers(rng: np.random.Generator, colour: Rgb | None) -> Picture:
    picture = coloured(colour or (186, 188, 190), 1.0 + 0.012 * layered(rng, (SIZE, SIZE), (1.0, 4.0)))
    for row in range(3):
        top = 10 + row * 166
        cv2.rectangle(picture, (14, top), (SIZE - 15, top + 158), (96, 98, 102), 4)
        fill(picture, (186, top + 46, 140, 16), (70, 72, 76))
        fill(picture, (186, top + 44, 140, 5), (216, 218, 220))
        fill(picture, (216, top + 84, 80, 34), (236, 234, 222))
        lines(picture, (224, top + 90, 60, 22), 2, (120, 120, 120), 4)
    return picture


def _carton(rng: np.random.Generator, colour: Rgb | None) -> Picture:
    shade = 1.0 + 0.03 * noise(rng, (SIZE, SIZE), (90.0, 2.0)) + 0.03 * noise(rng, (SIZE, SIZE), 50.0)
    fall = np.linspace(1.04, 0.88, SIZE)[:, None]
    picture = coloured(colour or (188, 148, 102), shade * fall)
    fill(picture, (232, 0, 48, 150), (206, 178, 128))
    left = int(rng.integers(40, 90))
    fill(picture, (left, 250, 150, 110), (240, 238, 232))
    lines(picture, (left + 12, 264, 126, 84), 5, (90, 90, 92), 6)
    for x in (380, 440):
        cv2.arrowedLine(picture, (x, 430), (x, 320), (96, 66, 42), 12, cv2.LINE_AA, tipLength=0.35)
    cv2.rectangle(picture, (0, 0), (SIZE - 1, SIZE - 1), (140, 106, 70), 6)
    return picture


def _screen(rng: np.random.Generator, colour: Rgb | None) -> Picture:
    picture = sheet(colour or (34, 40, 52))
    for row in range(14):
        left = 60 + 26 * int(rng.integers(0, 4))
        fill(picture, (left, 60 + 28 * row, int(rng.integers(60, 300)), 10), pick(rng))
    cv2.rectangle(picture, (0, 0), (SIZE - 1, SIZE - 1), (24, 24, 26), 36)
    return picture


def paint_poster(rng: np.random.Generator, colour: Rgb | None) -> Picture:
    """Paint one of four kinds of posters: a conference's, a landscape, circles, a sign."""
    kinds = (_paper_poster, _landscape, _circles, _sign)
    accent = colour or pick(rng)
    picture = kinds[int(rng.integers(len(kinds)))](rng, accent)
    cv2.rectangle(picture, (0, 0), (SIZE - 1, SIZE - 1), (226, 226, 222), 8)
    return picture


def _paper_poster(rng: np.random.Generator, accent: Rgb) -> Picture:
    picture = sheet(PAPER)
    fill(picture, (0, 0, SIZE, 92), accent)
    lines(picture, (40, 26, 400, 44), 2, (248, 246, 240), 12)
    for column in range(3):
        left, top = 24 + column * 160, 112
        while top < 470:
            height = int(rng.integers(60, 130))
            height = min(height, 496 - top)
            if rng.random() < 0.45 and height > 50:
                _chart(picture, (left, top, 144, height - 10), rng)
            else:
                fill(picture, (left, top, 90, 10), accent)
                lines(picture, (left, top + 18, 144, height - 26), max((height - 26) // 11, 1), (130, 130, 132), 4)
            top += height
    return picture


def _chart(picture: Picture, box: tuple[int, int, int, int], rng: np.random.Generator) -> None:
    left, top, width, height = box
    fill(picture, box, (224, 228, 232))
    if rng.random() < 0.5:
        for bar, share in enumerate(rng.uniform(0.2, 0.95, 6)):
            tall = int(share * (height - 8))
            fill(picture, (left + 8 + bar * 22, top + height - tall, 16, tall), pick(rng))
    else:
        for _ in range(2):
            ups = top + height - rng.uniform(0.1, 0.9, 7).cumsum() / 7 * (height - 10) * 1.4
            points = np.stack([np.linspace(left + 6, left + width - 6, 7), ups.clip(top + 4)], axis=1)
            cv2.polylines(picture, [points.astype(np.int32)], False, pick(rng), 4, cv2.LINE_AA)


def _landscape(rng: np.random.Generator, accent: Rgb) -> Picture:
    fade = np.linspace(0, 1, SIZE)[:, None, None]
    top, low = np.array(pick(rng)) * 0.6 + 90, np.array([250, 226, 190])
    picture = as_picture(np.broadcast_to(top * (1 - fade) + low * fade, (SIZE, SIZE, 3)))
    cv2.circle(
        picture, (int(rng.integers(110, 400)), int(rng.integers(110, 220))), 52, (252, 240, 200), -1, cv2.LINE_AA
    )
    across = np.arange(SIZE)
    for depth in range(4):
        ridge = 230 + 62 * depth + 46 * layered(rng, (1, SIZE), (24.0, 90.0 + 20 * depth))[0]
        outline = [np.array([*np.stack([across, ridge], axis=1), (SIZE, SIZE), (0, SIZE)]).astype(np.int32)]
        tint = np.array(accent) * (0.45 + 0.15 * depth) + 90 * (1 - depth / 3)
        cv2.fillPoly(picture, outline, tint.clip(0, 255).tolist(), cv2.LINE_AA)
    lines(picture, (60, 452, 390, 40), 2, (246, 244, 236), 10)
    return picture


def _circles(rng: np.random.Generator, accent: Rgb) -> Picture:
    picture = sheet((238, 230, 212))
    colours = [accent, pick(rng), pick(rng), INK]
    for row in range(4):
        for column in range(4):
            left, top = column * 128, row * 128
            cell = picture[top : top + 128, left : left + 128]
            cell[:] = colours[int(rng.integers(4))] if rng.random() < 0.5 else (238, 230, 212)
            centre = (int(rng.integers(2)) * 128, int(rng.integers(2)) * 128)
            patch = np.ascontiguousarray(cell)
            cv2.circle(patch, centre, 128, colours[int(rng.integers(4))], -1, cv2.LINE_AA)
            cv2.circle(patch, centre, 60, colours[int(rng.integers(4))], -1, cv2.LINE_AA)
            cell[:] = patch
    return picture


def _sign(rng: np.random.Generator, accent: Rgb) -> Picture:
    picture = sheet(PAPER)
    fill(picture, (0, 0, SIZE, 340), accent)
    sides = int(rng.integers(3, 7))
    turn = np.linspace(0, 2 * np.pi, sides, endpoint=False) - np.pi / 2
    corners = [np.stack([256 + 140 * np.cos(turn), 178 + 140 * np.sin(turn)], axis=1).astype(np.int32)]
    cv2.fillPoly(picture, corners, (250, 248, 240), cv2.LINE_AA)
    fill(picture, (240, 110, 32, 90), INK)
    cv2.circle(picture, (256, 226), 18, INK, -1, cv2.LINE_AA)
    lines(picture, (50, 370, 412, 120), 4, INK, 14)
    return picture


#: Painters by the name of the face.
FACES: Final[dict[str, FacePainter]] = {
    "books": _books, "carton": _carton, "door": _door, "drawers": _drawers, "poster": paint_poster, "screen": _screen,
    "whiteboard": _whiteboard, "window": _window,
}  # fmt: skip
