"""Meshes of buildings and barriers with their finishes; every roof is closed from below."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import Polygon

from services.kit.going_on import each
from services.simulator.scene.facades import (
    BARE,
    BAY_M,
    BAYS,
    GROUND,
    STOREY_M,
    STOREYS,
    UPPER,
    alike,
    in_steps,
)
from services.simulator.scene.meshes import (
    Mesh,
    band,
    faces,
    flat,
    outline,
    running,
    triangles,
    tube,
    walls,
)
from services.simulator.scene.surfaces import Finish, Piece
from services.simulator.world.terrain import POST_M, Barrier, BarrierKind, Building, Facade

_OVERHANG_M: Final = 0.4
_FASCIA_M: Final = 0.15
_CORNICE_M: Final = 0.18
# Default slope (rise over run) of a pitched roof.
_SLOPE: Final = 0.6
# A footprint that fills less of its bounding rectangle gets no ridge along that rectangle.
_OBLONG: Final = 0.85
# Fraction of the inscribed circle's radius that slopes cover (the rest is level): on an angled
# footprint, which needs slopes on its arms, and on a rectangle.
_SLOPED: Final = 0.7
_TO_THE_RIDGE: Final = 0.99
_METRES: Final = (4.0, 4.0)
_WALL_METRES: Final = (BAYS * BAY_M, STOREY_M)
# Roof colours are rounded, since each colour is a separate picture.
_COLOUR_STEP: Final = 32
# Minimum wall height and length for a window.
_LOW_M: Final = 1.5
_PIER_M: Final = 1.2
# Slightly less than the full height, or filtering would mix the foot into the top.
_GROUND_ROWS: Final = (0.99, 0.01)
_TRIM: Final = Finish("trim")
_BARRIER: Final[dict[BarrierKind, tuple[str, float]]] = {
    "hedge": ("hedge", 0.7), "wall": ("stone_wall", 0.3), "fence": ("fence", 0.08)
}  # fmt: skip


def buildings(items: Sequence[Building]) -> Iterator[Piece]:
    """Yield walls, roofs, undersides and canopy posts of all buildings."""
    looks = alike(building.facade for building in items)
    for building in each(items):
        facade = looks[building.facade]
        low = building.min_height_m
        for ring in outline(building.footprint):
            yield from _walls(ring, building, facade)
        yield from _flat(building) if building.roof == "flat" else _pitched(building, facade)
        if low > 0.0:
            yield _TRIM, flat(building.footprint, low, 4.0).flipped()
            yield from (
                (_TRIM, tube((x, y, 0.0), (x, y, low), (POST_M, POST_M), 6))
                for x, y in building.posts
            )


def barriers(items: Iterable[Barrier]) -> Iterator[Piece]:
    """Yield hedges, walls and fences with their thickness."""
    for barrier in items:
        material, thickness = _BARRIER[barrier.kind]
        body = barrier.line.buffer(thickness / 2, cap_style="flat")
        yield Finish(material), band(body, 0.0, barrier.height_m, 2.0)
        yield Finish(material), flat(body, barrier.height_m, 2.0)


def _walls(ring: NDArray[np.float64], building: Building, facade: Facade) -> Iterator[Piece]:
    low = building.min_height_m
    top = building.height_m
    wide = np.linalg.norm(np.diff(ring, axis=0), axis=1) >= _PIER_M
    if top - low < _LOW_M:
        wide[:] = False
    if not wide.all():
        rows = (-low / STOREY_M, -top / STOREY_M)
        yield (
            Finish(facade, None, BARE),
            walls(ring, low, top, running(ring) / (BAYS * BAY_M), rows, ~wide),
        )
    if not wide.any():
        return
    storeys = max(1, round((top - low) / STOREY_M))
    first = low
    if low == 0.0:
        first = top / storeys
        yield Finish(facade, None, GROUND), walls(ring, 0.0, first, _bays(ring), _GROUND_ROWS, wide)
        storeys -= 1
    if storeys:
        yield (
            Finish(facade, None, UPPER),
            walls(ring, first, top, _bays(ring), (storeys / STOREYS, 0.0), wide),
        )


def _bays(ring: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the texture coordinates (k - 1, 2) of the ends of each wall, in whole bays."""
    lengths = np.linalg.norm(np.diff(ring, axis=0), axis=1)
    bays = np.maximum(1, np.round(lengths / BAY_M))
    first = np.arange(len(lengths)) % BAYS
    return np.stack([first, first + bays], axis=1) / BAYS


def _flat(building: Building) -> Iterator[Piece]:
    """Yield a level roof behind a cornice; courtyards stay open."""
    top = building.height_m
    edge = building.footprint.buffer(_CORNICE_M, join_style="mitre")
    yield _cover("gravel", building), flat(building.footprint, top + 0.05, 4.0)
    yield _TRIM, flat(edge, top - 0.3, 4.0).flipped()
    yield _TRIM, band(edge, top - 0.3, top + 0.35, 4.0)


def _pitched(building: Building, facade: Facade) -> Iterator[Piece]:
    """Yield a gabled roof for a nearly rectangular building, else slopes along all edges."""
    top = building.height_m
    footprint = building.footprint
    cover = _cover("slate" if building.facade.variant % 2 else "tiles", building)
    box = footprint.minimum_rotated_rectangle
    fills = (
        isinstance(box, Polygon)
        and not footprint.interiors
        and footprint.area >= _OBLONG * box.area
    )
    gabled = fills and building.roof == "gabled"
    eaves = (box if gabled else footprint).buffer(_OVERHANG_M, join_style="mitre")
    yield _TRIM, flat(eaves, top - _FASCIA_M, 4.0).flipped()
    yield _TRIM, band(eaves, top - _FASCIA_M, top, 4.0)
    if not gabled:
        around, level = _around(
            eaves, top, building.roof_height_m, _TO_THE_RIDGE if fills else _SLOPED
        )
        yield cover, around
        yield from ((Finish("gravel"), part) for part in level)
        return
    a, b, c, d = np.insert(outline(eaves)[0][:4], 2, top, axis=1)
    if np.linalg.norm(b - a) < np.linalg.norm(c - b):
        a, b, c, d = b, c, d, a
    rise = building.roof_height_m or _SLOPE * float(np.linalg.norm(c - b)) / 2
    first = (a + d) / 2 + (0.0, 0.0, rise)
    last = (b + c) / 2 + (0.0, 0.0, rise)
    yield (
        cover,
        faces(np.array([[a, b, last], [a, last, first], [c, d, first], [c, first, last]]), _METRES),
    )
    yield Finish(facade, None, BARE), faces(np.array([[b, c, last], [d, a, first]]), _WALL_METRES)


def _around(eaves: Polygon, z: float, rise_m: float, sloped: float) -> tuple[Mesh, list[Mesh]]:
    """Return slopes along all edges of a footprint, and the level parts in its middle."""
    run = sloped * shapely.maximum_inscribed_circle(eaves, tolerance=0.1).length
    inner = eaves.buffer(-run, join_style="mitre", mitre_limit=2.0)
    rise = rise_m or _SLOPE * run
    points = triangles(eaves.difference(inner))
    edge = shapely.union_all([eaves.exterior, *eaves.interiors])
    high = shapely.distance(shapely.points(points), edge) > run / 2
    corners = np.concatenate([points, np.where(high, z + rise, z)[..., None]], axis=-1)
    level = [flat(part, z + rise, 4.0) for part in shapely.get_parts(inner) if not part.is_empty]
    return faces(corners, _METRES), level


def _cover(material: str, building: Building) -> Finish:
    colour = building.roof_colour
    return Finish(material, colour and in_steps(colour, _COLOUR_STEP))
