"""Worlds to render: an open field with one house, and towns of any number of buildings."""

from __future__ import annotations

from typing import Final, Literal, get_args

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import LineString, Polygon

from services.simulator.world import Pose, World
from services.simulator.world.terrain import Building, Facade, FacadeStyle, Road, RoofShape, Terrain, Tree, TreeKind

#: Blocks of 6 buildings between the middles of streets, metres.
_BLOCK_M: Final = (84.0, 64.0)
_STREET_M: Final = 7.0
_PLOTS: Final = np.array([(x, y) for x in (17.0, 42.0, 67.0) for y in (18.0, 46.0)])
_STYLES: Final[tuple[FacadeStyle, ...]] = get_args(FacadeStyle)
_ROOFS: Final[tuple[RoofShape, ...]] = get_args(RoofShape)
_TREES: Final[tuple[TreeKind, ...]] = get_args(TreeKind)


def field() -> World:
    """Return what is about the least to be seen: grass to the horizon, one house, the sky."""
    house = Building(shapely.box(-4.0, -4.0, 4.0, 4.0), 6.0, Facade("plaster", None, 0), "flat")
    terrain = Terrain("field", (-60.0, -60.0, 60.0, 60.0), (house,), (), (), (), (), 0)
    return World(terrain, Pose(-20.0, 0.0, 0.0), Pose(40.0, 40.0, 0.0))


def town(buildings: int, seed: int = 1) -> World:
    """Return blocks of houses between streets with sidewalks and trees; start and victim are on one street.

    Parameters
    ----------
    buildings
        How many; the last block may have fewer than the others.
    seed
        Another seed gives other houses, in the same places.
    """
    rng = np.random.default_rng(seed)
    blocks = -(-buildings // len(_PLOTS))
    columns = round(np.sqrt(blocks * _BLOCK_M[1] / _BLOCK_M[0])) or 1
    rows = -(-blocks // columns)
    corners = np.array([(k % columns, k // columns) for k in range(blocks)]) * _BLOCK_M
    places = (corners[:, None] + _PLOTS).reshape(-1, 2)[:buildings]
    size = np.array([columns, rows]) * _BLOCK_M
    roads = _streets(columns, rows, size)
    middle = float(rows // 2 * _BLOCK_M[1])
    terrain = Terrain(
        f"town of {buildings}",
        (-20.0, -20.0, float(size[0]) + 20.0, float(size[1]) + 20.0),
        tuple(_house(place, rng) for place in places),
        roads,
        (),
        tuple(_trees(corners, rng)),
        (),
        0,
    )
    return World(terrain, Pose(2.0, middle, 0.0), Pose(float(size[0]) - 8.0, middle, 0.0))


def _streets(columns: int, rows: int, size: NDArray[np.float64]) -> tuple[Road, ...]:
    across = [LineString([(0.0, row * _BLOCK_M[1]), (size[0], row * _BLOCK_M[1])]) for row in range(rows + 1)]
    along = [LineString([(k * _BLOCK_M[0], 0.0), (k * _BLOCK_M[0], size[1])]) for k in range(columns + 1)]
    return tuple(Road(line, _STREET_M, "street", True, True, sidewalks=True) for line in (*across, *along))


def _house(place: NDArray[np.float64], rng: np.random.Generator) -> Building:
    """Return a house of a random size, shape and look."""
    half = rng.uniform((6.0, 5.0), (10.0, 9.0))
    west, south, east, north = *(place - half), *(place + half)
    x, y = place
    bent = [(west, south), (east, south), (east, y), (x, y), (x, north), (west, north)]
    shape = Polygon(bent) if rng.random() < 0.3 else shapely.box(west, south, east, north)
    red, green, blue = (int(level) for level in rng.uniform(90, 210) + rng.uniform(-30, 30, 3))
    look = Facade(_STYLES[rng.integers(len(_STYLES))], (red, green, blue), int(rng.integers(6)))
    roof = _ROOFS[rng.integers(len(_ROOFS))]
    return Building(shape, float(rng.uniform(4.0, 18.0)), look, roof, 0.0, 0.0 if roof == "flat" else 3.5)


def _trees(corners: NDArray[np.float64], rng: np.random.Generator) -> list[Tree]:
    """Return four trees a block, between the sidewalk and the houses."""
    kinds: list[Literal["round", "tall", "conifer"]] = [_TREES[k] for k in rng.integers(len(_TREES), size=4)]
    return [
        Tree(float(x + along), float(y + 7.5), float(rng.uniform(5.0, 11.0)), kind)
        for x, y in corners
        for along, kind in zip((12.0, 30.0, 54.0, 74.0), kinds, strict=True)
    ]
