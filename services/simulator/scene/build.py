"""A world as meshes, pictures and lights, ready for any renderer; knows nothing of SAPIEN."""

from __future__ import annotations

from typing import TYPE_CHECKING

from services.simulator.scene import indoors, outdoors
from services.simulator.world.room import Room
from services.simulator.world.terrain import Terrain

if TYPE_CHECKING:
    from services.simulator.scene.surfaces import Scene
    from services.simulator.variation import Daylight
    from services.simulator.world.place import World


def build_scene(world: World, light: Daylight, *, shadows: bool) -> Scene:
    """Make the meshes, pictures and lights of a world; takes seconds.

    Parameters
    ----------
    world
        What to build.
    light
        Sun and sky outdoors, and how bright a room is.
    shadows
        Whether what stands on the ground darkens it.

    Raises
    ------
    TypeError
        The world's place is of a kind that nobody can draw.
    """
    match world.place:
        case Terrain() as terrain:
            return outdoors.build(terrain, world.victim, light, shadows=shadows)
        case Room() as room:
            return indoors.build(room, world.victim, light, shadows=shadows)
        case other:
            raise TypeError(f"no scene is known for a {type(other).__name__}")
