"""Ground meshes: streets with kerbs, sidewalks and markings, paths, lawns and shadows.

Layers are cut out of each other and lie in one plane, which avoids z-fighting in the distance. Only
the small markings lie on top, higher than paint, so that the depth buffer separates them.
"""

import itertools
from collections.abc import Iterator
from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import MultiPolygon, Polygon
from shapely.geometry.base import BaseGeometry
from shapely.ops import substring

from services.kit.going_on import each
from services.simulator.scene.meshes import UP, flat, triangles
from services.simulator.scene.surfaces import Finish, Piece
from services.simulator.world.place import Bounds, polygons
from services.simulator.world.terrain import AreaKind, Road, Terrain

_KERB_M: Final = 0.15
_SIDEWALK_M: Final = 2.0
_BEYOND_M: Final = 250.0
_DASH_M: Final = (2.0, 3.0)
_MARKING_M: Final = 0.12
_JOIN_M: Final = 1.0
_PAINT_M: Final = 0.01
# Segments of a quarter circle: a street corner of 4 m deviates from the arc by at most 8 cm.
_ROUND: Final = 4
# Tolerance of shadow edges; fewer corners draw faster.
_SHADE_M: Final = 0.1
_TEXTURE_M: Final = 4.0
# The cost of cutting layers grows faster than the square of their corners.
_TILE_M: Final = 250.0
_AREA_MATERIAL: Final[dict[AreaKind, str]] = {"water": "water", "paved": "paved", "grass": "lawn"}


def ground(terrain: Terrain, shade: BaseGeometry) -> Iterator[Piece]:
    """Yield the ground of a terrain and its margin; in `shade` its normals face off the sun."""
    claims = _claims(terrain)
    shapely.prepare([claim for _, claim in claims])
    shapely.prepare(shade)
    for tile in each(
        _tiles(shapely.box(*terrain.bounds).buffer(_BEYOND_M, join_style="mitre").bounds)
    ):
        for material, layer in _layers(claims, tile).items():
            yield from _laid(material, layer, shade, 0.0)
    marks = shapely.union_all(
        list(_dashes([road for road in terrain.roads if road.kind == "street"]))
    )
    yield from _laid("marking", marks, shade, _PAINT_M)


def _laid(material: str, area: BaseGeometry, shade: BaseGeometry, z: float) -> Iterator[Piece]:
    for parts, normal in ((area.difference(shade), UP), (area.intersection(shade), -UP)):
        yield from (
            (Finish(material), flat(part, z, _TEXTURE_M, normal)) for part in polygons(parts, 1e-4)
        )


def _tiles(bounds: Bounds) -> list[Polygon]:
    """Return the grid squares of `_TILE_M` that cover the bounds, clipped to them."""
    columns, rows = (
        np.unique(
            np.clip(_TILE_M * np.arange(low // _TILE_M, high // _TILE_M + 2), low, high)
        ).tolist()
        for low, high in (bounds[::2], bounds[1::2])
    )
    sides = itertools.product(itertools.pairwise(columns), itertools.pairwise(rows))
    return [shapely.box(left, bottom, right, top) for (left, right), (bottom, top) in sides]


def _claims(terrain: Terrain) -> list[tuple[str, BaseGeometry]]:
    """Return the overlapping areas of each material; earlier claims win, grass fills the rest."""
    streets = [road for road in terrain.roads if road.kind == "street"]
    paths = [road for road in terrain.roads if road.kind == "path"]
    asphalt = shapely.union_all([_widened(road) for road in streets])
    claims: list[tuple[str, BaseGeometry]] = [
        ("asphalt", asphalt),
        ("kerb", asphalt.buffer(_KERB_M, quad_segs=_ROUND)),
        (
            "sidewalk",
            shapely.union_all([_widened(road, _SIDEWALK_M) for road in streets if road.sidewalks]),
        ),
        ("path", shapely.union_all([_widened(road) for road in paths])),
    ]
    for kind, material in _AREA_MATERIAL.items():
        claims.append(
            (
                material,
                shapely.union_all([area.footprint for area in terrain.areas if area.kind == kind]),
            )
        )
    frame = shapely.box(*terrain.bounds)
    return [(material, claim.intersection(frame)) for material, claim in claims]


def _layers(claims: list[tuple[str, BaseGeometry]], tile: Polygon) -> dict[str, BaseGeometry]:
    """Partition a tile by material, without overlaps and gaps."""
    layers: dict[str, BaseGeometry] = {}
    left: BaseGeometry = tile
    for material, claim in claims:
        if not claim.intersects(tile):
            continue
        # Where a claim touches the remaining area, the intersection contains lines and points as
        # well.
        layers[material] = MultiPolygon(polygons(left.intersection(claim), 1e-4))
        left = left.difference(claim)
    return layers | {"grass": left}


def _widened(road: Road, more_m: float = 0.0) -> Polygon:
    return road.line.buffer(road.width_m / 2 + more_m, quad_segs=_ROUND)


def _dashes(streets: list[Road]) -> Iterator[Polygon]:
    dash, gap = _DASH_M
    joins = np.array([_widened(road, _JOIN_M) for road in streets], dtype=object)
    tree = shapely.STRtree(joins)
    for number, road in enumerate(streets):
        if road.marked:
            near = tree.query(road.line, predicate="intersects")
            crossings = shapely.union_all(joins[near[near != number]])
            shapely.prepare(crossings)
            for start in np.arange(gap, road.line.length - dash, dash + gap):
                line = substring(road.line, start, start + dash)
                if not crossings.intersects(line):
                    yield line.buffer(_MARKING_M / 2, cap_style="flat")


def cast_shade(
    terrain: Terrain, sun: tuple[float, float, float], crowns: list[tuple[Polygon, float, float]]
) -> BaseGeometry:
    """Return the shadow on the ground of buildings, barriers and crowns (outline, low, high)."""
    step = np.array(sun[:2]) / -sun[2]
    solids = [
        (house.footprint, house.min_height_m, house.height_m + house.roof_height_m / 2)
        for house in terrain.buildings
    ]
    solids += [
        (barrier.line.buffer(0.15, cap_style="flat"), 0.0, barrier.height_m)
        for barrier in terrain.barriers
    ]
    swept = [
        _swept(outline, step * low, step * high) for outline, low, high in each([*solids, *crowns])
    ]
    return shapely.union_all(swept).simplify(_SHADE_M)


def _swept(polygon: Polygon, begin: NDArray[np.float64], end: NDArray[np.float64]) -> BaseGeometry:
    """Return the area swept by a polygon between two displacements (2,)."""
    corners = triangles(polygon)
    # A triangle is convex, and so is its swept area.
    ends = np.concatenate([corners + begin, corners + end], axis=1)
    return shapely.union_all(shapely.convex_hull(shapely.multipoints(ends)))
