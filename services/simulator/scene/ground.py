"""The ground: streets with kerbs, sidewalks and markings, paths, lawns, and the shade that lies on them.

All layers are cut out of each other and lie in one plane, so that nothing flickers in the distance.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
import shapely
from shapely import Polygon, affinity
from shapely.ops import substring

from services.simulator.scene.meshes import Mesh, merge
from services.simulator.scene.shapes import UP, flat
from services.simulator.world.terrain import AreaKind, Road, Terrain

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from shapely.geometry.base import BaseGeometry

    from services.simulator.scene.textures import Material

_KERB_M: Final = 0.15
_SIDEWALK_M: Final = 2.0
_BEYOND_M: Final = 250.0
_DASH_M: Final = (2.0, 3.0)
_MARKING_M: Final = 0.12
_TEXTURE_M: Final = 4.0
_AREA_MATERIAL: Final[dict[AreaKind, Material]] = {"water": "water", "paved": "paved", "grass": "lawn"}


def ground(terrain: Terrain, shade: BaseGeometry) -> dict[Material, Mesh]:
    """Return the ground of a terrain, and of some land around it.

    Parameters
    ----------
    terrain
        The world.
    shade
        Where no sun comes, as an area; empty for a world without shadows. Those parts get a normal that points away
        from the sun, so that shade costs nothing while rendering.
    """
    meshes: dict[Material, Mesh] = {}
    for material, layer in _layers(terrain).items():
        sunny, shady = layer.difference(shade), layer.intersection(shade)
        parts = [flat(part, 0.0, _TEXTURE_M) for part in _polygons(sunny)]
        parts += [flat(part, 0.0, _TEXTURE_M, -UP) for part in _polygons(shady)]
        if parts:
            meshes[material] = merge(parts)
    return meshes


def _layers(terrain: Terrain) -> dict[Material, BaseGeometry]:
    """Return what each material covers, without overlaps; the first to claim a place keeps it."""
    streets = [road for road in terrain.roads if road.kind == "street"]
    asphalt = shapely.union_all([road.line.buffer(road.width_m / 2) for road in streets])
    marked = [road.line.buffer(road.width_m / 2 + _SIDEWALK_M) for road in streets if road.sidewalks]
    claims: list[tuple[Material, BaseGeometry]] = [
        ("marking", shapely.union_all([dash for road in streets if road.marked for dash in _dashes(road, streets)])),
        ("asphalt", asphalt),
        ("kerb", asphalt.buffer(_KERB_M)),
        ("sidewalk", shapely.union_all(marked)),
        ("path", shapely.union_all([r.line.buffer(r.width_m / 2) for r in terrain.roads if r.kind == "path"])),
    ]
    for kind, material in _AREA_MATERIAL.items():
        claims.append((material, shapely.union_all([area.polygon for area in terrain.areas if area.kind == kind])))
    frame = shapely.box(*terrain.bounds)
    claims.append(("grass", frame.buffer(_BEYOND_M)))
    layers: dict[Material, BaseGeometry] = {}
    taken: BaseGeometry = Polygon()
    for material, claim in claims:
        inside = claim if material == "grass" else claim.intersection(frame)
        layers[material] = inside.difference(taken)
        taken = taken.union(inside)
    return layers


def _dashes(road: Road, streets: list[Road]) -> list[Polygon]:
    """Return the dashes along the middle of a road, except where another road joins."""
    others = [other.line.buffer(other.width_m / 2 + 1.0) for other in streets if other is not road]
    crossings = shapely.union_all([other for other in others if other.intersects(road.line)])
    dash, gap = _DASH_M
    starts = np.arange(gap, road.line.length - dash, dash + gap)
    lines = [substring(road.line, start, start + dash) for start in starts]
    return [line.buffer(_MARKING_M / 2, cap_style="flat") for line in lines if not line.intersects(crossings)]


def cast_shade(
    terrain: Terrain, sun: tuple[float, float, float], crowns: list[tuple[Polygon, float, float]]
) -> BaseGeometry:
    """Return where the ground lies in the shade of buildings, barriers and tree crowns.

    Parameters
    ----------
    terrain
        The world.
    sun
        Direction of the sunlight, pointing down.
    crowns
        Of each tree crown the outline from above, and the heights of its lower and upper end in metres.
    """
    step = np.array(sun[:2]) / -sun[2]
    solids = [(building.footprint, 0.0, building.height_m) for building in terrain.buildings]
    solids += [(barrier.line.buffer(0.15), 0.0, barrier.height_m) for barrier in terrain.barriers]
    return shapely.union_all([_swept(outline, step * low, step * high) for outline, low, high in [*solids, *crowns]])


def _swept(polygon: Polygon, begin: NDArray[np.float64], end: NDArray[np.float64]) -> BaseGeometry:
    """Return what a polygon covers while it is pushed from one displacement (2,) to another."""
    ring = shapely.get_coordinates(polygon.exterior)
    edges = np.stack([ring[:-1] + begin, ring[1:] + begin, ring[1:] + end, ring[:-1] + end], axis=1)
    # An edge along the push sweeps no area; its flat quadrilateral would be invalid.
    sides = [side for side in map(Polygon, edges) if side.is_valid]
    ends = [affinity.translate(polygon, *shift) for shift in (begin, end)]
    return shapely.union_all([*sides, *ends])


def _polygons(geometry: BaseGeometry) -> list[Polygon]:
    parts = getattr(geometry, "geoms", [geometry])
    return [part for part in parts if isinstance(part, Polygon) and part.area > 1e-4]
