"""A world as meshes, pictures and lights, ready for any renderer; knows nothing of SAPIEN."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from shapely import Polygon

from services.simulator.scene import bodies, room
from services.simulator.scene.buildings import barriers, buildings
from services.simulator.scene.ground import cast_shade, ground
from services.simulator.scene.meshes import ball, make
from services.simulator.scene.plants import crowns, trees
from services.simulator.scene.surfaces import Lights, Scene, Surface, surfaces
from services.simulator.scene.textures import BOTTOM_DEG, TOP_DEG, paint_sky
from services.simulator.variation import Daylight
from services.simulator.world.place import World
from services.simulator.world.room import Room
from services.simulator.world.terrain import Terrain

_SKY_RADIUS_M: Final = 900.0
_SKY_SEED: Final = 7


def build_scene(world: World, light: Daylight, *, shadows: bool) -> Scene:
    """Make the meshes, pictures and lights of a world; takes seconds.

    `shadows` says whether what stands on the ground darkens it.
    """
    terrain = world.place
    if isinstance(terrain, Room):
        return room.build(terrain, world.victim, light, shadows=shadows)
    if not isinstance(terrain, Terrain):
        raise TypeError(f"no scene is known for a {type(terrain).__name__}")
    shaded = shadows and light.casts_shadows
    shade = cast_shade(terrain, light.direction, crowns(terrain.trees)) if shaded else Polygon()
    # What is drawn first hides what comes later: the ground is last, since it lies behind everything.
    things = [*buildings(terrain.buildings), *barriers(terrain.barriers), *trees(terrain.trees)]
    return Scene(
        lights=_lights(light),
        still=(*surfaces(things), *surfaces(ground(terrain, shade))),
        victim=surfaces((finish, mesh.placed(world.victim)) for finish, mesh in bodies.body("person")),
        sky=_sky(light),
    )


def _lights(light: Daylight) -> Lights:
    """Return the sun, and more sky from opposite it than from elsewhere, so that shaded walls keep their shape."""
    east, north, _ = light.direction
    level = max(math.hypot(east, north), 1e-9)
    opposite = (-0.9 * east / level, -0.9 * north / level, -0.2)
    return Lights(light.sky, ((light.direction, light.sun), (opposite, light.fill)))


def _sky(light: Daylight) -> Surface:
    """Return a dome whose inside wears the sky; it goes with the camera, so that it never comes closer."""
    detail = 24
    dome = ball((0, 0, 0), (1, 1, 1), detail)
    elevation = np.degrees(np.arcsin(np.clip(dome.vertices[:, 2], -1, 1)))
    uvs = np.column_stack([dome.uvs[:, 0] / 2, np.clip((TOP_DEG - elevation) / (TOP_DEG - BOTTOM_DEG), 0.002, 0.998)])
    inside = make(dome.vertices * _SKY_RADIUS_M, dome.normals, uvs, dome.triangles).flipped()
    return Surface(inside, paint_sky(_SKY_SEED, light), glows=True)
