"""Load a world by name or path: a map or a world file in, a place with start and victim out. Never the renderer."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from scipy.sparse.csgraph import connected_components
from shapely import LineString, STRtree, points
from shapely.errors import GEOSException

from schemas.codec import printable
from services.simulator.world.collision import obstacles_of
from services.simulator.world.json_file import read_json
from services.simulator.world.osm import Surroundings, read_osm
from services.simulator.world.place import Pose, World, WorldError
from services.simulator.world.roles import choose_roles
from services.simulator.world.room_file import read_room
from services.simulator.world.route import lane_graph, plan_route
from services.simulator.world.tagging import terrain_from
from services.simulator.world.terrain import Terrain
from services.simulator.world.terrain_file import read_terrain
from services.simulator.world.terrain_format import FORMAT

if TYPE_CHECKING:
    from services.simulator.world.osm import OsmExtract

WORLDS_FOLDER: Final = Path(__file__).parents[1] / "known_worlds"
_ROOM_FORMAT: Final = "smal.room/1"
_SUFFIXES: Final = (".osm", ".json")
# A route leaves out points that are this close to it.
_ON_ROUTE_M: Final = 0.03


@dataclass(frozen=True)
class Wishes:
    """What a person asks of the task in a map, and of how much of it to take.

    Attributes
    ----------
    start, victim
        By hand, in the metres of the world; None for what the map says, else by rule.
    seed
        Another one gives another task by rule.
    around
        The part of the map to take; None for all of it.
    """

    start: Pose | None = None
    victim: Pose | None = None
    seed: int = 0
    around: Surroundings | None = None


def known_worlds() -> list[str]:
    """Return the names of the worlds that come with the project, sorted."""
    return sorted({path.stem for suffix in _SUFFIXES for path in WORLDS_FOLDER.glob(f"*{suffix}")})


def load_world(name_or_path: str | Path) -> World:
    """Load a world.

    Parameters
    ----------
    name_or_path
        The name of a world that comes with the project, or the path of an OpenStreetMap XML file or of a world file
        (its name ends in .json). In a map, a node tagged `smal:role=start` (with `direction=` in degrees clockwise from
        north) and one tagged `smal:role=victim` set the task; a plain extract has none, and gets one by rule (see
        `roles.choose_roles`).

    Raises
    ------
    WorldError
        The world is unknown, unreadable, of no known format, empty, or its victim cannot be reached.
    """
    path = _find(name_or_path)
    return _world_of_file(path) if path.suffix == ".json" else world_of_map(path)


def world_of_map(path: Path, wishes: Wishes | None = None) -> World:
    """Turn an OpenStreetMap XML file into a world.

    Raises
    ------
    WorldError
        The file is unreadable or too large, has no buildings or roads, or the victim cannot be reached.
    """
    wishes = wishes or Wishes()
    extract = read_osm(path, wishes.around)
    try:
        terrain = terrain_from(extract, path.stem, path.name)
    except GEOSException as error:
        raise WorldError(f"{path}: its outlines cannot be cut to size ({printable(str(error))})") from error
    _check_content(terrain, path)
    start = wishes.start or _role(extract, "start", path)
    victim = wishes.victim or _role(extract, "victim", path)
    try:
        roles = choose_roles(terrain, start, victim, wishes.seed)
    except WorldError as error:
        raise WorldError(f"{path}: {error}") from None
    world = World(terrain, *roles)
    check_task(world, path)
    return world


def check_task(world: World, path: Path) -> None:
    """Refuse a world whose task cannot be done.

    Raises
    ------
    WorldError
        Start or victim are in an obstacle, or no way leads from one to the other.
    """
    for name, pose, radius_m in (("start", world.start, world.robot.radius_m), ("victim", world.victim, 0.0)):
        if not obstacles_of(world.place).is_free(pose.x, pose.y, radius_m):
            raise WorldError(
                f"{path}: the {name} at ({pose.x:.1f}, {pose.y:.1f}) m stands in an obstacle or outside the world"
            )
    try:
        plan_route(world, (world.start.x, world.start.y))
    except WorldError as error:
        raise WorldError(f"{path}: {error}") from None


def connected(world: World) -> World:
    """Return a world in whose terrain only those roads are drivable that the way to the victim is connected to."""
    terrain = world.place
    if not isinstance(terrain, Terrain):
        return world
    graph = lane_graph(terrain)
    _, component = connected_components(graph.costs, directed=False)
    route = LineString(plan_route(world, (world.start.x, world.start.y)))
    near = STRtree(np.asarray(points(graph.points))).query(route, "dwithin", _ON_ROUTE_M)
    reached = STRtree(np.asarray(points(graph.points[np.isin(component, component[near])])))
    roads = tuple(
        replace(road, drivable=road.drivable and len(reached.query(road.line, "dwithin", 0.02)) > 0)
        for road in terrain.roads
    )
    return replace(world, place=replace(terrain, roads=roads))


def _world_of_file(path: Path) -> World:
    content = read_json(path)
    named = content.get("format")
    if named == _ROOM_FORMAT:
        return read_room(content, path)
    if named == FORMAT:
        world = read_terrain(content, path)
        if isinstance(world.place, Terrain):
            _check_content(world.place, path)
        check_task(world, path)
        return world
    found = f"is {printable(str(named))!r}" if "format" in content else "is missing"
    raise WorldError(f"{path}: its format {found}; known are {FORMAT} and {_ROOM_FORMAT}")


def _check_content(terrain: Terrain, path: Path) -> None:
    if not terrain.buildings or not terrain.roads:
        missing = "buildings" if not terrain.buildings else "roads"
        raise WorldError(f"{path}: the map has no {missing}; a world needs both buildings and roads")


def _find(name_or_path: str | Path) -> Path:
    path = Path(name_or_path)
    if path.suffix or len(path.parts) != 1 or path.is_file():
        if not path.is_file():
            raise WorldError(f"{path}: no such file")
        return path
    for suffix in _SUFFIXES:
        named = WORLDS_FOLDER / f"{path}{suffix}"
        if named.is_file():
            return named
    raise WorldError(f"unknown world '{path}'; known are {', '.join(known_worlds()) or 'none'}, or give a path")


def _role(extract: OsmExtract, role: str, path: Path) -> Pose | None:
    nodes = [node for node in extract.nodes if node.tags.get("smal:role") == role]
    if len(nodes) > 1:
        raise WorldError(f"{path}: {len(nodes)} nodes are tagged smal:role={role}; one is allowed")
    if not nodes:
        return None
    direction = nodes[0].tags.get("direction", "0")
    if not re.fullmatch(r"-?\d+(\.\d+)?", direction):
        raise WorldError(f"{path}: direction={direction} of smal:role={role} is not a number of degrees")
    heading = math.remainder(math.pi / 2 - math.radians(float(direction)), math.tau)
    return Pose(float(nodes[0].xy[0]), float(nodes[0].xy[1]), heading)
