"""Buildings and barriers as meshes, grouped by the picture they wear."""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from services.kit.going_on import each
from services.simulator.scene.facades import BAY_M, BAYS, STOREY_M, STOREYS, alike
from services.simulator.scene.meshes import Mesh, merge
from services.simulator.scene.shapes import band, flat, outline, running, tube, walls
from services.simulator.world.terrain import POST_M, Barrier, BarrierKind, Building, Facade

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from numpy.typing import NDArray

    from services.simulator.scene.textures import Material

# Walls lower than this have no room for a window.
_LOW_M: Final = 1.5
# A wall too short for a window is bare.
_PIER_M: Final = 1.2
# Not quite the whole height of the picture, or filtering would mix its foot into its top.
_GROUND_ROWS: Final = (0.99, 0.01)
_BARRIER: Final[dict[BarrierKind, tuple[Material, float]]] = {
    "hedge": ("hedge", 0.7), "wall": ("stone_wall", 0.3), "fence": ("fence", 0.08)
}  # fmt: skip


#: Walls of the upper storeys, of the ground floor, and without windows.
Parts = tuple[list[Mesh], list[Mesh], list[Mesh]]


class Clad(NamedTuple):
    """The parts of walls by the picture they wear; a part that no building has is None."""

    upper: Mesh | None
    ground: Mesh | None
    bare: Mesh | None


def clad(buildings: Iterable[Building], gables: Mapping[int, Mesh] | None = None) -> dict[Facade, Clad]:
    """Return the walls of all buildings for each façade that is painted.

    Parameters
    ----------
    buildings
        What to clad; many with different façades share those that look most alike.
    gables
        Upright ends of roofs, by the number of the building, which wear the same wall.
    """
    every = tuple(buildings)
    looks = alike(building.facade for building in every)
    parts: dict[Facade, Parts] = defaultdict(lambda: ([], [], []))
    for number, building in enumerate(each(every)):
        part = parts[looks[building.facade]]
        for ring in outline(building.footprint):
            _clad_ring(ring, building, part)
        if gables and number in gables:
            part[2].append(gables[number])
    return {facade: Clad(*(merge(meshes) if meshes else None for meshes in part)) for facade, part in parts.items()}


def _clad_ring(ring: NDArray[np.float64], building: Building, part: Parts) -> None:
    """Add the walls along a ring to the upper storeys, the ground floor and the bare walls."""
    upper, ground, bare = part
    low, top = building.min_height_m, building.height_m
    wide = np.linalg.norm(np.diff(ring, axis=0), axis=1) >= _PIER_M
    if top - low < _LOW_M:
        wide[:] = False
    if not wide.all():
        rows = (-low / STOREY_M, -top / STOREY_M)
        bare.append(walls(ring, low, top, running(ring) / (BAYS * BAY_M), rows, ~wide))
    if not wide.any():
        return
    storeys = max(1, round((top - low) / STOREY_M))
    first = low
    if low == 0.0:
        first = top / storeys
        ground.append(walls(ring, 0.0, first, _bays(ring), _GROUND_ROWS, wide))
        storeys -= 1
    if storeys:
        upper.append(walls(ring, first, top, _bays(ring), (storeys / STOREYS, 0.0), wide))


def undersides(buildings: Iterable[Building]) -> list[Mesh]:
    """Return what is seen from below of buildings that begin above the ground, with posts under small ones."""
    meshes = []
    for building in buildings:
        low = building.min_height_m
        if low > 0.0:
            meshes.append(flat(building.footprint, low, 4.0).flipped())
            meshes += [tube((x, y, 0.0), (x, y, low), (POST_M, POST_M), 6) for x, y in building.posts]
    return meshes


def barriers(items: Iterable[Barrier]) -> dict[Material, list[Mesh]]:
    """Return hedges, walls and fences with their own thickness."""
    meshes: dict[Material, list[Mesh]] = defaultdict(list)
    for barrier in items:
        material, thickness = _BARRIER[barrier.kind]
        body = barrier.line.buffer(thickness / 2, cap_style="flat")
        meshes[material] += [band(body, 0.0, barrier.height_m, 2.0), flat(body, barrier.height_m, 2.0)]
    return meshes


def _bays(ring: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the texture coordinate (k - 1, 2) at both ends of each wall: whole bays, none cut by a corner."""
    lengths = np.linalg.norm(np.diff(ring, axis=0), axis=1)
    bays = np.maximum(1, np.round(lengths / BAY_M))
    first = np.arange(len(lengths)) % BAYS
    return np.stack([first, first + bays], axis=1) / BAYS
