"""Façade pictures: upper storeys with windows, a ground floor with doors, a bare wall."""

import zlib
from collections.abc import Iterable
from dataclasses import astuple
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.simulator.scene.faces import fill
from services.simulator.scene.textures import Picture, as_picture, coloured, layered
from services.simulator.tables import table
from services.simulator.world.place import Rgb
from services.simulator.world.terrain import Facade, FacadeStyle

#: Bays side by side, and upper storeys above each other, in a picture.
BAYS: Final = 4
STOREYS: Final = 4
BAY_M: Final = 3.2
STOREY_M: Final = 3.0

#: Index of a façade's pictures: upper storeys, ground floor, bare wall.
UPPER, GROUND, BARE = range(3)
MOST_LOOKS: Final = 64  # Maximum number of painted façades in a world; each takes 7 MB.

_CELL_PX: Final = 256
# Rounding of colours and number of variants, finest first: 5 styles by 8 colours or none.
_ROUNDINGS: Final = (
    (1, 2**32),
    (16, 2**32),
    (64, 2**32),
    (64, 8),
    (64, 4),
    (128, 4),
    (128, 2),
    (128, 1),
)
_WALL_COLOURS: Final = table("facades", dict[FacadeStyle, tuple[Rgb, ...]])


class _Plan(NamedTuple):
    """Window layout of a façade, as fractions of a bay and a storey."""

    wall: Rgb
    frame: Rgb
    width: float
    height: float
    panes: tuple[int, int]
    surround: bool


def alike(facades: Iterable[Facade]) -> dict[Facade, Facade]:
    """Map each façade to the façade painted for it: at most `MOST_LOOKS`, rounded as needed."""
    wanted = dict.fromkeys(facades)
    for colours, variants in _ROUNDINGS:
        found = {
            one: Facade(
                one.style, one.colour and in_steps(one.colour, colours), one.variant % variants
            )
            for one in wanted
        }
        if len(set(found.values())) <= MOST_LOOKS:
            return found
    raise AssertionError("unreachable: the coarsest rounding is within the limit")


def in_steps(colour: Rgb, step: int) -> Rgb:
    """Round a colour to the middle of its step."""
    red, green, blue = (level // step * step + step // 2 for level in colour)
    return red, green, blue


@lru_cache(maxsize=1)
def paint_facade(facade: Facade) -> tuple[Picture, Picture, Picture]:
    """Paint the pictures of a façade, uint8 RGB, seamless to the sides.

    Equal façades give equal pictures.

    Returns
    -------
    tuple of array
        `UPPER` (1024, 1024, 3) with 4 by 4 windows, `GROUND` (256, 1024, 3) with 4 bays and a
        door, and `BARE` (256, 1024, 3) without windows, for gables and low bands.
    """
    seed = zlib.crc32(repr(astuple(facade)).encode())
    rng = np.random.default_rng(seed)
    plan = _plan(facade, rng)
    upper = _wall(facade.style, plan.wall, STOREYS, rng)
    ground = _wall(facade.style, plan.wall, 1, rng)
    # A plinth anchors the building visually.
    ground[-26:] = as_picture(ground[-26:].astype(np.float64) * 0.45 + 52)
    for bay in range(BAYS):
        for storey in range(STOREYS):
            _window(upper, plan, bay, storey, rng)
        if bay == facade.variant % BAYS:
            _door(ground, plan, bay, rng)
        else:
            _window(ground, plan, bay, 0, rng)
    return upper, ground, _wall(facade.style, plan.wall, 1, rng)


def _plan(facade: Facade, rng: np.random.Generator) -> _Plan:
    choices = _WALL_COLOURS[facade.style]
    wall = facade.colour or choices[facade.variant % len(choices)]
    dark = facade.style == "glass" or bool(rng.random() < 0.4)
    frame = (58, 60, 64) if dark else (232, 230, 224)
    if facade.style == "glass":
        return _Plan(wall, frame, 0.94, 0.72, (int(rng.integers(2, 4)), 1), False)
    width = rng.uniform(0.34, 0.62)
    height = rng.uniform(0.46, 0.62)
    if facade.style == "concrete":
        width = rng.uniform(0.55, 0.9)
    panes = int(rng.integers(1, 4)), int(rng.integers(1, 4))
    return _Plan(
        wall,
        frame,
        float(width),
        float(height),
        panes,
        facade.style in {"brick", "plaster", "wood"},
    )


def _wall(style: FacadeStyle, colour: Rgb, storeys: int, rng: np.random.Generator) -> Picture:
    shape = (storeys * _CELL_PX, BAYS * _CELL_PX)
    sheet = _weather_sheet()
    shifted = np.roll(sheet, rng.integers(0, sheet.shape[0], 2).tolist(), axis=(0, 1))
    shade = 1.0 + 0.03 * shifted[: shape[0], : shape[1]]
    if style == "brick":
        shade *= _courses(shape, rng, course_px=8, brick_px=24)
    elif style == "wood":
        shade *= np.where(np.arange(shape[0]) % 16 < 2, 0.72, 1.0)[:, None]
    elif style == "concrete":
        rows = np.arange(shape[0]) % _CELL_PX
        columns = np.arange(shape[1]) % _CELL_PX
        shade *= np.where((rows < 3)[:, None] | (columns < 3)[None, :], 0.75, 1.0)
        shade *= 1.0 + 0.03 * rng.standard_normal(BAYS).repeat(_CELL_PX)
    return coloured(colour, shade)


@lru_cache(maxsize=1)
def _weather_sheet() -> NDArray[np.float64]:
    """Return noise for the weathering of walls; each wall takes a section, since noise is slow."""
    return layered(np.random.default_rng(0), (STOREYS * _CELL_PX, BAYS * _CELL_PX), (2.0, 60.0))


def _courses(
    shape: tuple[int, int], rng: np.random.Generator, course_px: int, brick_px: int
) -> NDArray[np.float64]:
    row, column = np.indices(shape)
    course = row // course_px
    shifted = (column + (course % 2) * (brick_px // 2)) % shape[1]
    tones = 1.0 + 0.10 * rng.standard_normal((shape[0] // course_px, shape[1] // brick_px + 1))
    joint = (row % course_px < 1) | (shifted % brick_px < 1)
    return np.asarray(np.where(joint, 1.18, tones[course, shifted // brick_px]), dtype=np.float64)


def _window(picture: Picture, plan: _Plan, bay: int, storey: int, rng: np.random.Generator) -> None:
    width = int(plan.width * _CELL_PX)
    height = int(plan.height * _CELL_PX)
    left = bay * _CELL_PX + (_CELL_PX - width) // 2
    top = storey * _CELL_PX + int((_CELL_PX - height) * 0.42)
    if plan.surround:
        fill(
            picture,
            (left - 10, top - 16, width + 20, 12),
            tuple(int(0.5 * c + 110) for c in plan.wall),
        )
        fill(picture, (left - 12, top + height + 5, width + 24, 9), (198, 194, 184))
    fill(picture, (left - 5, top - 5, width + 10, height + 10), plan.frame)
    _glaze(picture, (left, top, width, height), rng)
    across, down = plan.panes
    for line in range(1, across):
        fill(picture, (left + line * width // across - 3, top, 6, height), plan.frame)
    for line in range(1, down):
        fill(picture, (left, top + line * height // down - 3, width, 6), plan.frame)


def _glaze(picture: Picture, box: tuple[int, int, int, int], rng: np.random.Generator) -> None:
    """Paint a pane with a reflection of pale sky above dark trees, and possibly a blind."""
    left, top, width, height = box
    fade = np.linspace(1.0, 0.0, height)[:, None, None]
    sky = np.array([132, 152, 170])
    dark = np.array([44, 52, 60])
    pane = np.broadcast_to(dark + (sky - dark) * fade**1.5, (height, width, 3)) * rng.uniform(
        0.75, 1.1
    )
    pane = pane.copy()
    if rng.random() < 0.35:
        pane[: int(height * rng.uniform(0.2, 0.7))] = np.array([206, 200, 186]) * rng.uniform(
            0.8, 1.0
        )
    pane[:6] *= 0.6
    picture[top : top + height, left : left + width] = as_picture(pane)


def _door(picture: Picture, plan: _Plan, bay: int, rng: np.random.Generator) -> None:
    width = 104
    height = 186
    left = bay * _CELL_PX + (_CELL_PX - width) // 2
    top = _CELL_PX - height
    paints = np.array([(92, 54, 38), (50, 72, 62), (66, 70, 92), (120, 40, 36)])
    leaf = tuple(int(value) for value in rng.choice(paints))
    fill(picture, (left - 10, top - 10, width + 20, height + 10), plan.frame)
    fill(picture, (left, top, width, height), leaf)
    _glaze(picture, (left + 12, top + 14, width - 24, 62), rng)
    fill(picture, (left + width // 2 - 2, top, 4, height), tuple(value // 2 for value in leaf))
    fill(picture, (left - 26, top - 28, width + 52, 14), tuple(int(0.6 * c) for c in plan.wall))
