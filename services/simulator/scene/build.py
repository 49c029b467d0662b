"""A world as meshes and pictures, ready for any renderer; knows nothing of SAPIEN."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from shapely import Polygon

from services.simulator.scene import bodies
from services.simulator.scene.facades import paint_facade
from services.simulator.scene.ground import cast_shade, ground
from services.simulator.scene.meshes import Mesh, make, merge
from services.simulator.scene.plants import crowns, trees
from services.simulator.scene.shapes import ball
from services.simulator.scene.sky import BOTTOM_DEG, TOP_DEG, paint_sky
from services.simulator.scene.structures import barriers, clad, roofs
from services.simulator.scene.textures import paint

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from numpy.typing import NDArray

    from services.simulator.scene.textures import Material
    from services.simulator.world.terrain import World

#: Where the sunlight goes: from the south-west, half way up.
SUN: Final = (0.55, 0.62, -0.72)
_SKY_RADIUS_M: Final = 900.0
_SKY_SEED: Final = 7


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh and the picture that it wears, (h, w, 3) uint8 RGB; `glows` for what needs no light."""

    mesh: Mesh
    picture: NDArray[np.uint8]
    glows: bool = False


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything to be drawn: what never moves, the sky about the camera, the victim, the robot about its origin."""

    sky: Surface
    still: tuple[Surface, ...]
    victim: tuple[Surface, ...]
    robot: tuple[Surface, ...]


def build_scene(world: World, *, shadows: bool) -> Scene:
    """Make the meshes and pictures of a world; takes seconds.

    Parameters
    ----------
    world
        What to build.
    shadows
        Whether buildings, barriers and trees darken the ground.
    """
    shade = cast_shade(world, SUN, crowns(world.trees)) if shadows else Polygon()
    pieces: dict[Material, list[Mesh]] = defaultdict(list)
    for part in (roofs(world.buildings), barriers(world.barriers), trees(world.trees)):
        for material, meshes in part.items():
            pieces[material] += meshes
    for material, mesh in ground(world, shade).items():
        pieces[material].append(mesh)
    lying = {
        material: [mesh.placed(world.victim) for mesh in meshes] for material, meshes in bodies.victim().items()
    }  # fmt: skip
    return Scene(
        sky=_sky(),
        still=(*_facades(world), *_surfaces(pieces)),
        victim=_surfaces(lying),
        robot=_surfaces(bodies.robot()),
    )


def _surfaces(pieces: Mapping[Material, Iterable[Mesh]]) -> tuple[Surface, ...]:
    return tuple(Surface(merge(meshes), paint(material)) for material, meshes in pieces.items())


def _facades(world: World) -> list[Surface]:
    surfaces = []
    for facade, walls in clad(world.buildings).items():
        upper, ground_floor = paint_facade(facade)
        surfaces.append(Surface(walls.ground, ground_floor))
        if walls.upper is not None:
            surfaces.append(Surface(walls.upper, upper))
    return surfaces


def _sky() -> Surface:
    """Return a dome whose inside wears the sky; it goes with the camera, so that it never comes closer."""
    detail = 24
    dome = ball((0, 0, 0), (1, 1, 1), detail)
    elevation = np.degrees(np.arcsin(np.clip(dome.vertices[:, 2], -1, 1)))
    uvs = np.column_stack([dome.uvs[:, 0] / 2, np.clip((TOP_DEG - elevation) / (TOP_DEG - BOTTOM_DEG), 0.002, 0.998)])
    inside = make(dome.vertices * _SKY_RADIUS_M, dome.normals, uvs, dome.triangles).flipped()
    return Surface(inside, paint_sky(_SKY_SEED), glows=True)
