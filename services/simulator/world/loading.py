"""Load a world by name or path: OpenStreetMap XML in, terrain with start and victim out. Never imports the renderer."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Final

from services.simulator.world.collision import obstacles_of
from services.simulator.world.osm import read_osm
from services.simulator.world.place import Pose, World, WorldError
from services.simulator.world.roles import choose_roles
from services.simulator.world.route import plan_route
from services.simulator.world.tagging import terrain_from

if TYPE_CHECKING:
    from services.simulator.world.osm import OsmExtract

WORLDS_FOLDER: Final = Path(__file__).resolve().parents[3] / "deploy" / "worlds"


def known_worlds() -> list[str]:
    """Return the names of the worlds that come with the project, sorted."""
    return sorted(path.stem for path in WORLDS_FOLDER.glob("*.osm"))


def load_world(name_or_path: str | Path) -> World:
    """Load a world.

    Parameters
    ----------
    name_or_path
        The name of a world in `deploy/worlds/`, or the path of an OpenStreetMap XML file. A node tagged
        `smal:role=start` (with `direction=` in degrees clockwise from north) and one tagged `smal:role=victim` set
        the task; a plain extract has none, and gets one by rule (see `roles.choose_roles`).

    Raises
    ------
    WorldError
        The world is unknown, unreadable, not OpenStreetMap, empty, or its victim cannot be reached.
    """
    path = _find(name_or_path)
    extract = read_osm(path)
    terrain = terrain_from(extract, path.stem)
    if not terrain.buildings or not terrain.roads:
        missing = "buildings" if not terrain.buildings else "roads"
        raise WorldError(f"{path}: the map has no {missing}; a world needs both buildings and roads")
    start, victim = choose_roles(terrain, _role(extract, "start", path), _role(extract, "victim", path))
    world = World(terrain, start, victim)
    if not obstacles_of(terrain).is_free(start.x, start.y):
        raise WorldError(f"{path}: the start at ({start.x:.1f}, {start.y:.1f}) m stands in an obstacle")
    plan_route(world, (start.x, start.y))
    return world


def _find(name_or_path: str | Path) -> Path:
    path = Path(name_or_path)
    if path.suffix or len(path.parts) != 1 or path.is_file():
        if not path.is_file():
            raise WorldError(f"{path}: no such file")
        return path
    named = WORLDS_FOLDER / f"{path}.osm"
    if not named.is_file():
        raise WorldError(f"unknown world '{path}'; known are {', '.join(known_worlds()) or 'none'}, or give a path")
    return named


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
