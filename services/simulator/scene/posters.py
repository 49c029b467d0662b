"""Posters: a conference's, a landscape, circles, a sign; which one, and how, is a matter of chance."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from services.simulator.scene.drawing import INK, PAPER, SIZE, Picture, fill, lines, pick, sheet
from services.simulator.scene.noise import as_picture, layered

if TYPE_CHECKING:
    from services.simulator.world.place import Rgb


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
    """Paint a sun over ranges of hills, the nearest in the accent's colour."""
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
    """Paint quarter circles in a grid, as in prints of the 1920s."""
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
    """Paint a notice: a big symbol on its colour, text below."""
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
