"""Buildings and barriers as meshes, grouped by the picture they wear."""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from services.simulator.scene.facades import BAY_M, BAYS, STOREY_M, STOREYS
from services.simulator.scene.meshes import Mesh, merge
from services.simulator.scene.shapes import band, flat, hipped_roof, outline, walls
from services.simulator.world.terrain import Barrier, BarrierKind, Building, Facade

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from services.simulator.scene.textures import Material

_OVERHANG_M: Final = 0.4
_ROOF_SLOPE: Final = 0.6
_CORNICE_M: Final = 0.18
# A wall too short for a window shows the bare strip at the edge of the façade's picture.
_PIER_M: Final = 1.2
_PIER_U: Final = 0.01
# Not quite the whole height of the picture, or filtering would mix its foot into its top.
_GROUND_ROWS: Final = (0.99, 0.01)
_BARRIER: Final[dict[BarrierKind, tuple[Material, float]]] = {
    "hedge": ("hedge", 0.7), "wall": ("stone_wall", 0.3), "fence": ("fence", 0.08)
}  # fmt: skip


class Clad(NamedTuple):
    """The two parts of a building's walls; a building of one storey has no upper part."""

    upper: Mesh | None
    ground: Mesh


def clad(buildings: Iterable[Building]) -> dict[Facade, Clad]:
    """Return the walls of all buildings, one pair of meshes for each façade."""
    uppers: dict[Facade, list[Mesh]] = defaultdict(list)
    grounds: dict[Facade, list[Mesh]] = defaultdict(list)
    for building in buildings:
        storeys = max(1, round(building.height_m / STOREY_M))
        first = building.height_m / storeys
        for ring in outline(building.footprint):
            u = _bays(ring)
            grounds[building.facade].append(walls(ring, 0.0, first, u, _GROUND_ROWS))
            if storeys > 1:
                rows = ((storeys - 1) / STOREYS, 0.0)
                uppers[building.facade].append(walls(ring, first, building.height_m, u, rows))
    return {
        facade: Clad(merge(uppers[facade]) if facade in uppers else None, merge(ground))
        for facade, ground in grounds.items()
    }  # fmt: skip


def roofs(buildings: Iterable[Building]) -> dict[Material, list[Mesh]]:
    """Return all roofs: hipped ones over four corners where asked for, else flat ones behind a cornice."""
    meshes: dict[Material, list[Mesh]] = defaultdict(list)
    for building in buildings:
        top = building.height_m
        if building.roof == "hipped" and len(building.footprint.exterior.coords) == 5:
            eaves = building.footprint.buffer(_OVERHANG_M, join_style="mitre")
            meshes["slate" if building.facade.variant % 2 else "tiles"].append(
                hipped_roof(eaves, top, _ROOF_SLOPE, 4.0)
            )
            meshes["trim"] += [flat(eaves, top - 0.15, 4.0).flipped(), band(eaves, top - 0.15, top, 4.0)]
        else:
            edge = building.footprint.buffer(_CORNICE_M, join_style="mitre")
            meshes["gravel"].append(flat(building.footprint, top + 0.05, 4.0))
            meshes["trim"] += [flat(edge, top - 0.3, 4.0).flipped(), band(edge, top - 0.3, top + 0.35, 4.0)]
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
    bays = np.where(lengths < _PIER_M, _PIER_U * BAYS, np.maximum(1, np.round(lengths / BAY_M)))
    first = np.where(lengths < _PIER_M, 0, np.arange(len(lengths)) % BAYS)
    return np.stack([first, first + bays], axis=1) / BAYS
