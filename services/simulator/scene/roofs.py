"""Roofs as meshes, grouped by what covers them: flat, gabled and hipped ones, each closed underneath."""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
import shapely
from shapely import Polygon

from services.kit.going_on import each
from services.simulator.scene.facades import BAY_M, BAYS, STOREY_M, in_steps
from services.simulator.scene.shapes import band, faces, flat, outline, ridged

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from services.simulator.scene.meshes import Mesh
    from services.simulator.scene.textures import Material
    from services.simulator.world.place import Rgb
    from services.simulator.world.terrain import Building

_OVERHANG_M: Final = 0.4
_FASCIA_M: Final = 0.15
_CORNICE_M: Final = 0.18
#: Rise over run of a pitched roof whose height nobody has said.
SLOPE: Final = 0.6
#: A footprint that fills less of the rectangle around it has no ridge along that rectangle.
OBLONG: Final = 0.85
# Part of the widest place of a footprint without a ridge that its slopes cover; the rest is level.
_SLOPED: Final = 0.7
_METRES: Final = (4.0, 4.0)
_WALL_METRES: Final = (BAYS * BAY_M, STOREY_M)
# Colours of roofs are rounded: each one is a picture of its own.
_COLOUR_STEP: Final = 32


class Cover(NamedTuple):
    """What a roof is made of; `colour` None for the material's own."""

    material: Material
    colour: Rgb | None = None


class Roofs(NamedTuple):
    """The roofs of some buildings; `gables` are the upright ends of each, by the number of the building."""

    covers: dict[Cover, list[Mesh]]
    gables: dict[int, Mesh]


def roofs(buildings: Iterable[Building]) -> Roofs:
    """Return all roofs; courtyards stay open."""
    covers: dict[Cover, list[Mesh]] = defaultdict(list)
    gables: dict[int, Mesh] = {}
    for number, building in enumerate(each(buildings)):
        if building.roof == "flat":
            _flat(building, covers)
            continue
        gable = _pitched(building, covers)
        if gable is not None:
            gables[number] = gable
    return Roofs(covers, gables)


def oblong(footprint: Polygon) -> NDArray[np.float64] | None:
    """Return the corners (4, 2) of the rectangle around a footprint that nearly fills it, the first side a long one.

    Anticlockwise; None for a footprint with courtyards or of another shape.
    """
    around = footprint.minimum_rotated_rectangle
    if not isinstance(around, Polygon) or footprint.interiors or footprint.area < OBLONG * around.area:
        return None
    corners = outline(around)[0][:4]
    sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    return np.roll(corners, -1, axis=0) if sides[0] < sides[1] else corners


def _flat(building: Building, covers: dict[Cover, list[Mesh]]) -> None:
    """Add a level roof behind a cornice."""
    top = building.height_m
    edge = building.footprint.buffer(_CORNICE_M, join_style="mitre")
    covers[_cover("gravel", building)].append(flat(building.footprint, top + 0.05, 4.0))
    covers[Cover("trim")] += [flat(edge, top - 0.3, 4.0).flipped(), band(edge, top - 0.3, top + 0.35, 4.0)]


def _pitched(building: Building, covers: dict[Cover, list[Mesh]]) -> Mesh | None:
    """Add a roof over eaves that stick out; return its upright ends, where it has such."""
    top = building.height_m
    corners = oblong(building.footprint)
    cover = covers[_cover("slate" if building.facade.variant % 2 else "tiles", building)]
    below = building.footprint if corners is None else Polygon(corners)
    eaves = below.buffer(_OVERHANG_M, join_style="mitre")
    covers[Cover("trim")] += [flat(eaves, top - _FASCIA_M, 4.0).flipped(), band(eaves, top - _FASCIA_M, top, 4.0)]
    if corners is None:
        around, level = _around(eaves, top, building.roof_height_m)
        cover.append(around)
        covers[Cover("gravel")] += level
        return None
    long, across = _reach(corners)
    rise = building.roof_height_m or SLOPE * across / 2
    run = min(across, long) / 2 if building.roof == "hipped" else 0.0
    slopes, ends = ridged(oblong_eaves(corners), top, rise, run)
    if building.roof == "hipped":
        cover.append(faces(np.concatenate([slopes, ends]), _METRES))
        return None
    cover.append(faces(slopes, _METRES))
    return faces(ends, _WALL_METRES)


def oblong_eaves(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return corners (4, 2) of a rectangle moved outwards by the overhang, in the same order."""
    ahead = (corners[1] - corners[0]) / np.linalg.norm(corners[1] - corners[0])
    left = np.array([-ahead[1], ahead[0]])
    signs = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    return np.asarray(corners + _OVERHANG_M * (signs[:, :1] * ahead + signs[:, 1:] * left), dtype=np.float64)


def _reach(corners: NDArray[np.float64]) -> tuple[float, float]:
    """Return the lengths of the long and of the short side, of the eaves."""
    long, across = (float(np.linalg.norm(corners[k + 1] - corners[k])) for k in range(2))
    return long + 2 * _OVERHANG_M, across + 2 * _OVERHANG_M


def _around(eaves: Polygon, z: float, rise_m: float) -> tuple[Mesh, list[Mesh]]:
    """Return slopes along all the edges of any footprint, and the level parts in the middle of it."""
    widest = shapely.maximum_inscribed_circle(eaves, tolerance=0.1).length
    run = _SLOPED * widest
    inner = eaves.buffer(-run, join_style="mitre", mitre_limit=2.0)
    rise = rise_m or SLOPE * run
    triangles = shapely.get_parts(shapely.constrained_delaunay_triangles(eaves.difference(inner)))
    points = shapely.get_coordinates(shapely.orient_polygons(triangles)).reshape(-1, 4, 2)[:, :3]
    edge = shapely.union_all([eaves.exterior, *eaves.interiors])
    high = shapely.distance(shapely.points(points), edge) > run / 2
    corners = np.concatenate([points, np.where(high, z + rise, z)[..., None]], axis=-1)
    level = [flat(part, z + rise, 4.0) for part in getattr(inner, "geoms", [inner]) if not part.is_empty]
    return faces(corners, _METRES), level


def _cover(material: Material, building: Building) -> Cover:
    colour = building.roof_colour
    return Cover(material, colour and in_steps(colour, _COLOUR_STEP))
