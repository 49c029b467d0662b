"""An outdoor place as a scene: ground, buildings, plants, the sky above them."""

from __future__ import annotations

import math
from collections import defaultdict
from typing import TYPE_CHECKING, Final

import numpy as np
from shapely import Polygon

from services.kit.going_on import each
from services.simulator.scene import bodies
from services.simulator.scene.facades import paint_bare, paint_facade
from services.simulator.scene.ground import cast_shade, ground
from services.simulator.scene.meshes import Mesh, make, merge
from services.simulator.scene.noise import tinted
from services.simulator.scene.plants import crowns, trees
from services.simulator.scene.roofs import Cover, roofs
from services.simulator.scene.shapes import ball, outline
from services.simulator.scene.sky import BOTTOM_DEG, TOP_DEG, paint_sky
from services.simulator.scene.structures import barriers, clad, undersides
from services.simulator.scene.surfaces import Block, Lights, Scene, Surface, painted
from services.simulator.scene.textures import paint

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from services.simulator.scene.textures import Material
    from services.simulator.variation import Daylight
    from services.simulator.world.place import Pose
    from services.simulator.world.terrain import Terrain

_SKY_RADIUS_M: Final = 900.0
_SKY_SEED: Final = 7


def build(terrain: Terrain, victim: Pose, light: Daylight, *, shadows: bool) -> Scene:
    """Make the meshes and pictures of a terrain with a victim lying in it."""
    shaded = shadows and light.casts_shadows
    shade = cast_shade(terrain, light.direction, crowns(terrain.trees)) if shaded else Polygon()
    covers, gables = roofs(terrain.buildings)
    covers[Cover("trim")] += undersides(terrain.buildings)
    pieces: dict[Material, list[Mesh]] = defaultdict(list)
    for part in (barriers(terrain.barriers), trees(terrain.trees)):
        for material, meshes in part.items():
            pieces[material] += meshes
    lower: dict[Material, list[Mesh]] = {material: [mesh] for material, mesh in ground(terrain, shade).items()}
    lying = {material: [mesh.placed(victim) for mesh in meshes] for material, meshes in bodies.victim().items()}
    # What is drawn first hides what comes later: the ground is last, since it lies behind everything.
    return Scene(
        lights=_lights(light),
        still=(*_facades(terrain, gables), *_covers(covers), *painted(pieces), *painted(lower)),
        victim=painted(lying),
        robot=painted(bodies.robot(terrain.robot)),
        sky=_sky(light),
        blocks=tuple(_blocks(terrain)),
    )


def _blocks(terrain: Terrain) -> Iterator[Block]:
    for building in terrain.buildings:
        if building.min_height_m == 0.0:
            yield Block(outline(building.footprint)[0], building.height_m)


def _lights(light: Daylight) -> Lights:
    """Return the sun, and more sky from opposite it than from elsewhere, so that shaded walls keep their shape."""
    east, north, _ = light.direction
    level = max(math.hypot(east, north), 1e-9)
    opposite = (-0.9 * east / level, -0.9 * north / level, -0.2)
    return Lights(light.sky, ((light.direction, light.sun), (opposite, light.fill)))


def _facades(terrain: Terrain, gables: Mapping[int, Mesh]) -> Iterator[Surface]:
    for facade, walls in each(clad(terrain.buildings, gables).items()):
        upper, ground_floor = paint_facade(facade)
        if walls.upper is not None:
            yield Surface(walls.upper, upper)
        if walls.ground is not None:
            yield Surface(walls.ground, ground_floor)
        if walls.bare is not None:
            yield Surface(walls.bare, paint_bare(facade))


def _covers(covers: Mapping[Cover, list[Mesh]]) -> Iterator[Surface]:
    for (material, colour), meshes in each(covers.items()):
        if meshes:
            picture = paint(material)
            yield Surface(merge(meshes), picture if colour is None else tinted(picture, colour))


def _sky(light: Daylight) -> Surface:
    """Return a dome whose inside wears the sky; it goes with the camera, so that it never comes closer."""
    detail = 24
    dome = ball((0, 0, 0), (1, 1, 1), detail)
    elevation = np.degrees(np.arcsin(np.clip(dome.vertices[:, 2], -1, 1)))
    uvs = np.column_stack([dome.uvs[:, 0] / 2, np.clip((TOP_DEG - elevation) / (TOP_DEG - BOTTOM_DEG), 0.002, 0.998)])
    inside = make(dome.vertices * _SKY_RADIUS_M, dome.normals, uvs, dome.triangles).flipped()
    return Surface(inside, paint_sky(_SKY_SEED, light), glows=True)
