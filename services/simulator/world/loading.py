"""Load a world by name or path: a place with start and victim, without the renderer."""

import math
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from pydantic import Field, TypeAdapter, ValidationError
from scipy.sparse.csgraph import connected_components
from shapely import LineString, STRtree, points
from shapely.errors import GEOSException

from schemas.codec import describe, printable
from services.kit.going_on import go_on
from services.simulator.world.osm import Extract, MapSurroundings, read_osm
from services.simulator.world.place import Pose, World, WorldError
from services.simulator.world.room import Room, RoomFile
from services.simulator.world.route import first_pose, lane_graph, obstacles_of, plan_route
from services.simulator.world.scan import ScanFile
from services.simulator.world.survey import terrain_from
from services.simulator.world.task import choose_roles
from services.simulator.world.terrain import Terrain, TerrainFile, terrain_text
from smal.files.confined import ConfinedError, Work, WorkLimits, confined, size_of

WORLDS_FOLDER: Final = Path(__file__).parents[1] / "known_worlds"
_SUFFIXES: Final = (".osm", ".json")
# Bytes of a world file; a map of 5 MB becomes a world of about 1 MB.
LARGEST_FILE: Final = 32 * 1024 * 1024
MOST_MEMORY: Final = 4 * 2**30  # Memory limit of the child process that loads a world, bytes.
# Counted before parsing: an empty list takes three bytes of the file and sixty of memory.
_MOST_OF: Final = {b"[": 1_500_000, b"{": 500_000, b",": 5_000_000}
_FILE: Final[TypeAdapter[RoomFile | ScanFile | TerrainFile]] = TypeAdapter(
    Annotated[RoomFile | ScanFile | TerrainFile, Field(discriminator="format")]
)
# Lane points this close count as on the route, which omits points on straight legs.
_ON_ROUTE_M: Final = 0.03


@dataclass(frozen=True)
class RoleWishes:
    """Start and victim by hand, in metres of the world; None for the rule."""

    start: Pose | None = None
    victim: Pose | None = None
    ahead: bool = False  # Whether the start faces along the route.
    seed: int = 0  # Another seed gives another task by rule.


@dataclass(frozen=True)
class Wishes:
    """Task and extent that a user requests for a map."""

    task: RoleWishes = field(default_factory=RoleWishes)  # The map's tags come before the rule.
    around: MapSurroundings | None = None  # Part of the map to read; None for the whole map.


def known_worlds() -> list[str]:
    """Return the sorted names of the included worlds."""
    return sorted({path.stem for suffix in _SUFFIXES for path in WORLDS_FOLDER.glob(f"*{suffix}")})


def load_world(name_or_path: str | Path) -> World:
    """Load an included world by name, or a world file (*.json) or map (*.osm) by path.

    In a map, nodes tagged `smal:role=start` (with `direction=`, degrees clockwise from north) and
    `smal:role=victim` define the task; otherwise `task.choose_roles` does.

    Raises
    ------
    WorldError
        The world is not found, unreadable or empty, or has no route.
    """
    path = _find(name_or_path)
    return world_of_text(_read(path), path) if path.suffix == ".json" else world_of_map(path)


def load_foreign_world(name_or_path: str | Path) -> World:
    """Load a world; files of users are first loaded in a child process with resource limits."""
    path = _find(name_or_path)
    if path.parent != WORLDS_FOLDER:
        bounded("services.simulator.world.loading:prove", str(path), path)
    return load_world(path)


def prove(path: str, _work: Work) -> None:
    """Load a world in a child process; raises ConfinedError for an unusable world."""
    try:
        load_world(path)
    except WorldError as error:
        raise ConfinedError(str(error)) from None


def bounded(
    function: str,
    request: object,
    source: Path,
    pass_fds: Sequence[int] = (),
    progress: Callable[[Any], None] = lambda _: None,
) -> Any:  # noqa: ANN401 - JSON
    """Run a function on a map or world file in a child process with resource limits; see `confined`.

    Raises
    ------
    WorldError
        The file is unusable, or exceeds a limit.
    """
    limits = WorkLimits.of_size(size_of(source), MOST_MEMORY)
    try:
        return confined(
            function, request, limits, source, progress=progress, go_on=go_on, pass_fds=pass_fds
        )
    except ConfinedError as error:
        raise WorldError(printable(str(error), 700)) from None


def world_of_map(path: Path, wishes: Wishes = Wishes()) -> World:
    """Convert an OpenStreetMap file to a world; see `load_world`."""
    extract = read_osm(path, wishes.around)
    with naming(path):
        name = re.sub(r"(\.osm)?\.\w+$", "", path.name)
        terrain = terrain_from(extract, name, path.name)
        _check_content(terrain)
        task = wishes.task
        start = task.start or _role(extract, "start")
        victim = task.victim or _role(extract, "victim")
        world = turned_ahead(World(terrain, *choose_roles(terrain, start, victim, task.seed)), task)
        check_task(world)
    return world


def import_map(osm_map: Path, out: Path, wishes: Wishes) -> tuple[World, str]:
    """Import a map; return its world as read back, and the text of the world file."""
    text = terrain_text(_connected(world_of_map(osm_map, wishes)))
    return world_of_text(text.encode(), out), text


def _connected(world: World) -> World:
    """Keep only the roads drivable that are connected to the route to the victim."""
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


def _find(name_or_path: str | Path) -> Path:
    path = Path(name_or_path)
    named = [WORLDS_FOLDER / f"{path}{suffix}" for suffix in _SUFFIXES]
    if path.suffix or len(path.parts) != 1 or path.is_file():
        named = [path]
    found = next((one for one in named if one.is_file()), None)
    if found is None and named == [path]:
        raise WorldError(f"{path}: file not found")
    if found is None:
        raise WorldError(
            f"world '{path}' not found; choose from {', '.join(known_worlds())}, or give a path"
        )
    return found


def _read(path: Path) -> bytes:
    """Return the content of a world file after checks of its size and its number of elements."""
    try:
        size = path.stat().st_size
        if size > LARGEST_FILE:
            raise WorldError(
                f"{path}: too large ({size / 1e6:.0f} MB > maximum {LARGEST_FILE / 1e6:.0f} MB)"
            )
        data = path.read_bytes()
    except OSError as error:
        raise WorldError(f"{path}: {error.strerror}") from error
    for mark, most in _MOST_OF.items():
        if data.count(mark) > most:
            raise WorldError(
                f"{path}: too large (more than the maximum of {most:,} '{mark.decode()}')"
            )
    return data


def world_of_text(data: bytes, path: Path) -> World:
    """Parse a world file; `path` gives the name of the world."""
    with naming(path):
        world = _FILE.validate_json(data).world(path)
        if isinstance(world.place, Terrain):
            _check_content(world.place)
        if not isinstance(world.place, Room):  # A room has checked its task.
            check_task(world)
    return world


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Prefix errors about a world with its file, in one line."""
    try:
        yield
    except ValidationError as error:
        # Remove the format's name from the location of the error.
        raise WorldError(
            f"{path}: {re.sub(r'^(smal[.][a-z]+/1[.:] ?|message: )', '', describe(error))}"
        ) from None
    except GEOSException as error:
        raise WorldError(
            f"{path}: its outlines cannot be cut to size ({printable(str(error))})"
        ) from error
    except WorldError as error:
        raise WorldError(f"{path}: {error}") from None


def turned_ahead(world: World, task: RoleWishes) -> World:
    """Turn the start along the route if the task requests it."""
    if not task.ahead:
        return world
    return replace(world, start=first_pose(plan_route(world, (world.start.x, world.start.y))))


def _check_content(terrain: Terrain) -> None:
    if not terrain.buildings or not terrain.roads:
        missing = "buildings" if not terrain.buildings else "roads"
        raise WorldError(f"the map has no {missing}; a world needs both buildings and roads")


def check_task(world: World) -> None:
    """Reject a start or victim in an obstacle, and a victim without a route."""
    for name, pose, radius_m in (
        ("start", world.start, world.robot.radius_m),
        ("victim", world.victim, 0.0),
    ):
        if not obstacles_of(world.place).is_free(pose.x, pose.y, radius_m):
            raise WorldError(
                f"the {name} at ({pose.x:.1f}, {pose.y:.1f}) m stands in an obstacle or outside the world"
            )
    plan_route(world, (world.start.x, world.start.y))


def _role(extract: Extract, role: str) -> Pose | None:
    nodes = [node for node in extract.nodes if node.tags.get("smal:role") == role]
    if len(nodes) > 1:
        raise WorldError(f"{len(nodes)} nodes are tagged smal:role={role}; tag only one")
    if not nodes:
        return None
    (node,) = nodes
    direction = node.tags.get("direction", "0")
    if not re.fullmatch(r"-?\d+(\.\d+)?", direction):
        raise WorldError(f"direction={direction} of smal:role={role} is not a number of degrees")
    x, y = np.asarray(node.shape).tolist()
    return Pose(x, y, math.remainder(math.pi / 2 - math.radians(float(direction)), math.tau))
