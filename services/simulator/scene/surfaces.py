"""What a scene is made of: surfaces and lights."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from services.simulator.scene.meshes import Mesh, merge
from services.simulator.scene.textures import paint

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    import numpy as np
    from numpy.typing import NDArray

    from services.simulator.scene.textures import Material

Vector = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh and the picture that it wears, (h, w, 3) uint8 RGB; `glows` for what needs no light."""

    mesh: Mesh
    picture: NDArray[np.uint8]
    glows: bool = False


@dataclass(frozen=True, eq=False)
class Block:
    """Something upright on the ground that nobody can see through, for leaving out what is behind it.

    Attributes
    ----------
    outline
        (k, 2) corners, anticlockwise, the first one repeated at the end, metres.
    height_m
        Of the walls that stand on the whole outline.
    """

    outline: NDArray[np.float64]
    height_m: float


@dataclass(frozen=True)
class Lights:
    """Light from everywhere, and light from far away: (direction that it goes, colour) of each."""

    ambient: Vector
    directional: tuple[tuple[Vector, Vector], ...]


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything to be drawn.

    Attributes
    ----------
    lights
        What lights it.
    still
        What never moves.
    victim
        The victim, in its place.
    robot
        The robot, about its own origin, x forward.
    sky
        The dome that goes with the camera; None under a ceiling.
    blocks
        Parts of what never moves that hide what is behind them.
    """

    lights: Lights
    still: tuple[Surface, ...]
    victim: tuple[Surface, ...]
    robot: tuple[Surface, ...]
    sky: Surface | None = None
    blocks: tuple[Block, ...] = ()


def painted(pieces: Mapping[Material, Iterable[Mesh]]) -> tuple[Surface, ...]:
    """Return one surface for each material."""
    return tuple(Surface(merge(meshes), paint(material)) for material, meshes in pieces.items())
