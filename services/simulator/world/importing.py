"""From a map to the text of a world file, which is read back before anybody relies on it."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from services.simulator.world.loading import Wishes, check_task, connected, world_of_map
from services.simulator.world.osm import Surroundings, metres_per_degree
from services.simulator.world.place import Pose, World, WorldError
from services.simulator.world.terrain import Terrain
from services.simulator.world.terrain_file import read_terrain, terrain_text

if TYPE_CHECKING:
    from pathlib import Path

# Beyond start and victim, so that there is something to see behind them.
_MARGIN_M: Final = 20.0


def import_map(osm_map: Path, out: Path, wishes: Wishes, radius_m: float | None = None) -> tuple[World, str]:
    """Turn a map into a world.

    Parameters
    ----------
    osm_map
        The OpenStreetMap XML file.
    out
        The file that the world is for; nothing is written to it here.
    wishes
        Where the task is to be, and of what part of the map.
    radius_m
        Take only so much of the map on each side of the middle between start and victim; None for all.

    Returns
    -------
    The world as whoever reads the file will have it, and the text of the file.

    Raises
    ------
    WorldError
        The map cannot be used, or there is no way from start to victim.
    """
    world = world_of_map(osm_map, wishes)
    if radius_m is not None:
        world = world_of_map(osm_map, _about_the_task(world, wishes, radius_m, osm_map))
    text = terrain_text(connected(world))
    read = read_terrain(json.loads(text), out)
    check_task(read, out)
    return read, text


def _about_the_task(world: World, wishes: Wishes, radius_m: float, path: Path) -> Wishes:
    """Return the wish for the very same task with less of the map about it."""
    start, victim = world.start, world.victim
    apart_m = max(abs(start.x - victim.x), abs(start.y - victim.y)) / 2
    if radius_m < apart_m + _MARGIN_M:
        raise WorldError(
            f"{path}: a radius of {radius_m:.0f} m does not hold start and victim, which need "
            f"{math.ceil(apart_m + _MARGIN_M)} m"
        )
    terrain = world.place
    if not isinstance(terrain, Terrain) or terrain.source is None:
        raise TypeError("only a map's terrain can be cut")
    x, y = (start.x + victim.x) / 2, (start.y + victim.y) / 2
    east, north = metres_per_degree(terrain.source.latitude_deg)
    around = Surroundings(
        terrain.source.latitude_deg + y / float(north), terrain.source.longitude_deg + x / float(east), radius_m
    )
    moved = [Pose(pose.x - x, pose.y - y, pose.heading) for pose in (start, victim)]
    return replace(wishes, start=moved[0], victim=moved[1], around=around)
