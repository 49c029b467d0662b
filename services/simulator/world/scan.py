"""A scan of a real place: its free floor, and its world file, `smal.scan/1`.

The file NAME.npz beside the world file NAME.json holds the meshes and pictures. Metres are measured
from the south-west corner of the free floor, x to the east and y to the north; the floor is laid
level at height 0.
"""

import json
from collections.abc import Iterator
from dataclasses import asdict, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, ClassVar, Final, Literal

import numpy as np
import shapely
from numpy.typing import NDArray
from pydantic import Field
from pydantic.dataclasses import dataclass
from shapely import LineString, Polygon

from services.simulator.robots import ROBOTS, RobotModel
from services.simulator.world.lanes import LONGEST, floor_lanes
from services.simulator.world.place import (
    STRICT,
    Bounds,
    OverheadMount,
    Scale,
    Solid,
    World,
    WorldError,
    polygons,
)
from services.simulator.world.room import SCALE as ROOM_SCALE
from services.simulator.world.terrain import Many, Plan, Spot, rounded_plans, task_content

FORMAT: Final = "smal.scan/1"
MESH_SUFFIX: Final = ".npz"
Axis = Literal["x", "y", "z", "-x", "-y", "-z"]
RobotName = Literal["rescuebot", "turtlebot"]
# Width of the solid border around the floor.
_BORDER_M: Final = 0.5
# Solids are cut into tiles of this size, since a search in one large outline is slow.
_TILE_M: Final = 4.0
# Height of obstacles in the physics; the robot is lower.
_HEIGHT_M: Final = 2.0
# Length of legs off the lanes, in distances of lane ends.
_LEG: Final = 1.5
# Roughness of the floor's outline, in clearances.
_ROUGH: Final = 0.2
_WALL_M: Final = 1.0  # Length of the pieces of walls that a victim can stand beside.


@dataclass(frozen=True, eq=False, kw_only=True, config=STRICT)
class ScannedPlace:
    """A scanned place."""

    name: str = ""
    robot_name: RobotName
    sky: bool  # Whether the place is outdoors.
    floor: Plan  # Area that the robot's body can cover.
    walls: Many[Plan] = ()  # Things as high as the camera, which hide what is behind them.
    mesh: Path = Path()  # Mesh file; beside the world file.

    shake: ClassVar[float] = 1.0
    overhead: ClassVar[OverheadMount | None] = None

    @property
    def robot(self) -> RobotModel:
        """Robot for which the floor is free."""
        return ROBOTS[self.robot_name]

    @property
    def scale(self) -> Scale:
        """Typical distances for the robot; lanes are dense, so that they need no points between."""
        usual = ROOM_SCALE if self.robot.indoor else Scale()
        end_m = usual.lane_end_m
        return replace(usual, spacing_m=LONGEST * end_m, longest_leg_m=_LEG * end_m)

    @property
    def bounds(self) -> Bounds:
        """Bounds of the free floor with a border."""
        x_min, y_min, x_max, y_max = self.floor.footprint.buffer(_BORDER_M).bounds
        return x_min, y_min, x_max, y_max

    @cached_property
    def solids(self) -> tuple[Solid, ...]:
        """Everything outside of the free floor, in tiles."""
        x_min, y_min, x_max, y_max = self.bounds
        corners = np.meshgrid(np.arange(x_min, x_max, _TILE_M), np.arange(y_min, y_max, _TILE_M))
        x, y = (one.ravel() for one in corners)
        tiles = shapely.box(x, y, np.minimum(x + _TILE_M, x_max), np.minimum(y + _TILE_M, y_max))
        outside = polygons(shapely.difference(tiles, self.floor.footprint))
        walls = polygons(shapely.union_all([one.footprint for one in self.walls]))
        return (
            *(Solid(one, 0.0, _HEIGHT_M, opaque=False) for one in outside),
            *(Solid(one, 0.0, _HEIGHT_M, opaque=True) for one in walls),
        )

    @cached_property
    def lanes(self) -> tuple[LineString, ...]:
        """Lanes on the free floor."""
        scale = self.scale
        off = lambda distance_m: self.floor.footprint.buffer(-distance_m, quad_segs=2)  # noqa: E731
        return floor_lanes(off, self.bounds, scale, _ROUGH * scale.clearance_m)

    def walls_from(self, middle: shapely.Point) -> Iterator[NDArray[np.float64]]:
        """Yield pieces (2, 2) of the floor's edge with the solid on their left, nearest first."""
        whole = shapely.orient_polygons(self.floor.footprint)
        rings = (shapely.segmentize(one, _WALL_M) for one in (whole.exterior, *whole.interiors))
        points = [shapely.get_coordinates(ring)[::-1] for ring in rings]
        pieces = np.concatenate([np.stack([one[:-1], one[1:]], axis=1) for one in points])
        away = np.linalg.norm(pieces.mean(axis=1) - (middle.x, middle.y), axis=1)
        yield from pieces[np.argsort(away, kind="stable")]


@dataclass(frozen=True, eq=False, kw_only=True, config=STRICT)
class ScanFile(ScannedPlace):
    """A scan with a task, the content of a scan file."""

    format: Literal["smal.scan/1"]
    source: Annotated[str, Field(max_length=255)] = ""  # File name of the scan.
    start: Spot
    victim: Spot

    def world(self, path: Path) -> World:
        """Build the world of a file; raises WorldError without its mesh file."""
        mesh = path.with_suffix(MESH_SUFFIX)
        if not mesh.is_file():
            raise WorldError(f"{mesh} not found; a scan needs it beside its world file")
        place = replace(self, name=path.stem, mesh=mesh)
        return World(place, self.start.pose, self.victim.pose)


def scan_of(
    robot_name: RobotName, area: Polygon, walls: list[Polygon], *, sky: bool
) -> ScannedPlace:
    """Return a scan of outlines, rounded to millimetres; WorldError without an area of floor."""
    floors = [Plan(**fields) for fields in rounded_plans(area)]
    if not floors:
        raise WorldError("its floor is narrower than a millimetre; give --scale")
    return ScannedPlace(
        robot_name=robot_name,
        sky=sky,
        floor=max(floors, key=lambda one: one.footprint.area),
        walls=tuple(Plan(**fields) for wall in walls for fields in rounded_plans(wall)),
    )


def scan_text(world: World, source: str) -> str:
    """Return the file content of a world of a scan."""
    place = world.place
    if not isinstance(place, ScannedPlace):
        raise TypeError(f"unsupported place for {FORMAT}: {type(place).__name__}")
    content = {
        "format": FORMAT,
        "source": source[:255],
        "robot_name": place.robot_name,
        "sky": place.sky,
        **task_content(world),
        "floor": asdict(place.floor),
        "walls": [asdict(one) for one in place.walls],
    }
    return json.dumps(content) + "\n"
