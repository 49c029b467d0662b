"""Import a scan as a world: read it, find its floor, and choose a start and a victim."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Final

from services.simulator.robots import ROBOTS, RobotModel
from services.simulator.scanning.floor import FoundFloor, find_floor
from services.simulator.scanning.mesh_file import ScanPart
from services.simulator.scanning.reading import Scanned, read_scan
from services.simulator.world.loading import RoleWishes, check_task, naming, turned_ahead
from services.simulator.world.place import Pose, World, WorldError
from services.simulator.world.route import plan_route, route_length_m
from services.simulator.world.scan import RobotName, ScannedPlace, scan_of
from services.simulator.world.task import choose_roles

# Places under the sky of this area and more get the large robot.
_LARGE_M2: Final = 200.0
# A place indoors has a roof over at least this share of its floor.
_ROOFED: Final = 0.5


@dataclass(frozen=True)
class ScanWishes:
    """Choices of a user; None for the detected values.

    `scale` is in metres per unit of the file, `floor_m` the height of a floor in metres of the
    scan. `climb_m` is the height of the steps that the robot can climb.
    """

    task: RoleWishes = field(default_factory=RoleWishes)
    scale: float | None = None
    up: str | None = None
    floor_m: float | None = None
    robot: RobotName | None = None
    climb_m: float | None = None


@dataclass(frozen=True)
class ImportedScan:
    """A world with its meshes, and a summary as names and values."""

    world: World
    parts: tuple[ScanPart, ...]
    summary: tuple[tuple[str, str], ...]


def import_scan(
    source: Path,
    wishes: ScanWishes,
    progress: Callable[[str, int, int], None] = lambda _stage, _done, _total: None,
) -> ImportedScan:
    """Import a scan; raises WorldError for an unusable file.

    Parameters
    ----------
    source : Path
    wishes : ScanWishes
    progress : callable, optional
        Called with the name of a stage, the number of its parts that are done, and of all.
    """
    with naming(source):
        progress("reading the scan", 0, 1)
        scanned = read_scan(source, wishes.scale, wishes.up)
        progress("reading the scan", 1, 1)
        robot, found = _floor(scanned, wishes, progress)
        place = scan_of(robot, found.area, list(found.walls.geoms), sky=found.roofed < _ROOFED)
        task = wishes.task
        roles = _roles(place, task)
        world = turned_ahead(World(place, *roles), task)
        try:
            check_task(world)
        except WorldError as error:
            _, _, x_max, y_max = place.floor.footprint.bounds
            raise WorldError(
                f"{error}; choose --from and --to on the floor, x 0 to {x_max:.1f} and "
                f"y 0 to {y_max:.1f} m from its south-west corner, with room for the robot"
            ) from None
    summary = (*scanned.notes, *_summary(world, place, found, scanned))
    return ImportedScan(world, found.grade.levelled(scanned.parts), summary)


def _roles(place: ScannedPlace, task: RoleWishes) -> tuple[Pose, Pose]:
    """Choose start and victim, in one room in view of each other."""
    for hidden in (True, False):
        with suppress(WorldError):
            return choose_roles(place, task.start, task.victim, task.seed, hidden=hidden)
    raise WorldError(
        f"no way for the {place.robot_name} on {place.floor.footprint.area:.1f} m2 of floor; "
        "give --from and --to, or another --robot"
    )


def _floor(
    scanned: Scanned, wishes: ScanWishes, progress: Callable[[str, int, int], None]
) -> tuple[RobotName, FoundFloor]:
    """Return the robot and its floor; a large place outdoors gets the large robot."""

    def floor(name: RobotName) -> FoundFloor:
        stage = f"finding the floor of the {name}"
        return find_floor(
            scanned.faces, _climbing(name, wishes), wishes.floor_m, partial(progress, stage)
        )

    if wishes.robot is not None:
        return wishes.robot, floor(wishes.robot)
    with suppress(WorldError):  # The large robot fits into few rooms.
        large = floor("rescuebot")
        if large.roofed < _ROOFED and large.area.area > _LARGE_M2:
            return "rescuebot", large
    return "turtlebot", floor("turtlebot")


def _climbing(name: RobotName, wishes: ScanWishes) -> RobotModel:
    robot = ROBOTS[name]
    return robot if wishes.climb_m is None else replace(robot, climb_m=wishes.climb_m)


def _summary(
    world: World, place: ScannedPlace, found: FoundFloor, scanned: Scanned
) -> Iterator[tuple[str, str]]:
    robot = place.robot
    yield "place", f"{'outdoors' if place.sky else 'indoors'} ({found.roofed:.0%} under a roof)"
    yield "robot", f"{place.robot_name} (radius {robot.radius_m:g} m, height {robot.top_m:g} m)"
    yield "floor", f"{found.area.area:.1f} m2 at height {found.height_m:.2f} m"
    for height_m, area_m2 in found.storeys:
        yield "  found floor", f"{area_m2:.1f} m2 at height {height_m:.2f} m"
    yield "holes in the floor", f"{found.holes:.1%}"
    yield "edge without a wall", f"{found.open_edge:.1%}"
    yield "untextured", f"{scanned.untextured:.1%}"
    yield "triangles", f"{sum(len(part.triangles) for part in scanned.parts)}"
    x_min, y_min, x_max, y_max = place.floor.footprint.bounds
    yield "size", f"{x_max - x_min:.1f} x {y_max - y_min:.1f} m"
    for role, pose in (("start", world.start), ("victim", world.victim)):
        yield role, f"{pose.x:.2f},{pose.y:.2f}"
    yield "route", f"{route_length_m(plan_route(world, (world.start.x, world.start.y))):.1f} m"
