"""An indoor place: a rectangular room with furniture, and its world file, `smal.room/1`.

Metres are measured from the room's south-west corner, x to the east and y to the north. Angles are
anticlockwise from east: 0 is east, 90 north, 180 west, 270 south.
"""

import itertools
import math
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, ClassVar, Final, Literal

import numpy as np
import shapely
from numpy.typing import NDArray
from pydantic import Field
from pydantic.dataclasses import dataclass
from shapely import LineString, Polygon
from shapely.geometry.base import BaseGeometry

from services.simulator.robots import TURTLEBOT, RobotModel
from services.simulator.world.furniture import (
    HIDING_M,
    ROUND,
    Box,
    Colour,
    Degrees,
    Furniture,
    Metres,
    Size,
)
from services.simulator.world.lanes import floor_lanes
from services.simulator.world.place import (
    STRICT,
    Bounds,
    OverheadMount,
    Pose,
    Scale,
    Solid,
    World,
    WorldError,
)
from services.simulator.world.route import obstacles_of, plan_route

FittingKind = Literal["door", "poster", "whiteboard", "window"]
Wall = Literal["south", "east", "north", "west"]
SCALE: Final = Scale(
    spacing_m=0.25,
    clearance_m=0.26,
    room_m=0.55,
    lane_end_m=1.5,
    leg_room_m=0.55,
    leg_end_m=0.5,
    longest_leg_m=1.5,
    start_m=0.15,
    start_room_m=0.24,
    aside_m=0.3,
    last_m=0.8,
    found_m=1.2,
    moved_m=0.7,
)
# Radius of the space that a standing victim takes.
_VICTIM_RADIUS_M: Final = 0.16
_TOLERANCE_M: Final = 1e-6


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Fitting:
    """A flat object on a wall, out of the robot's reach."""

    kind: FittingKind
    wall: Wall
    along_m: Metres  # From the wall's left end to the object's middle, seen from inside the room.
    foot_m: Metres  # From the floor to the lower edge.
    width_m: Size
    height_m: Size
    variant: Annotated[int, Field(ge=0, lt=2**32)] = 0
    """Variant of the picture; equal variant and colour give equal pictures."""
    # Colour of a poster's paper or a door's leaf; by default the variant's.
    colour: Colour | None = None

    def face(self, ahead_m: float = 0.0) -> tuple[Box, float, float]:
        """Return the box before the wall, along it and off it, and the lower and upper height."""
        left_m = self.along_m - self.width_m / 2
        right_m = self.along_m + self.width_m / 2
        return (0.0, left_m, ahead_m, right_m), self.foot_m, self.foot_m + self.height_m


@dataclass(frozen=True, eq=False, kw_only=True, config=STRICT)
class Room:
    """A rectangular room."""

    name: str = ""
    east_west_m: Annotated[float, Field(ge=1.5, le=50)]  # From the west to the east wall.
    north_south_m: Annotated[float, Field(ge=1.5, le=50)]  # From the south to the north wall.
    walls_m: Annotated[float, Field(ge=1, le=10)] = 2.8
    floor: Literal["lino"] = "lino"
    wall_colour: Colour = (230, 226, 216)
    furniture: Annotated[tuple[Furniture, ...], Field(max_length=200)]
    fittings: Annotated[tuple[Fitting, ...], Field(max_length=200)] = ()
    # Overhead camera, if present; it sees through the ceiling.
    overhead: OverheadMount | None = None

    #: Robot and scale of the paper's laboratory; the paper's TurtleBot often shook.
    robot: ClassVar[RobotModel] = TURTLEBOT
    scale: ClassVar[Scale] = SCALE
    shake: ClassVar[float] = 1.0

    @property
    def bounds(self) -> Bounds:
        """From the south-west to the north-east corner."""
        return 0.0, 0.0, self.east_west_m, self.north_south_m

    @cached_property
    def solids(self) -> tuple[Solid, ...]:
        """Solid parts of the furniture, and the walls."""
        walls = Solid(shapely.box(*self.bounds).exterior, 0.0, self.walls_m, opaque=True)
        return (*(solid for piece in self.furniture for solid in piece.solids), walls)

    @cached_property
    def lanes(self) -> tuple[LineString, ...]:
        """Lanes of the free floor.

        No lane leads under tables, where the overhead camera cannot see the robot.
        """
        return floor_lanes(self._floor_off_things, self.bounds, self.scale)

    def _floor_off_things(self, distance_m: float) -> BaseGeometry:
        """Return the floor at least `distance_m` from furniture and walls."""
        floor = shapely.box(*self.bounds).buffer(-distance_m)
        return floor.difference(
            shapely.union_all([_grown(piece, distance_m) for piece in self.furniture])
        )

    def wall(self, wall: Wall) -> tuple[Pose, float]:
        """Return a wall's left end with the inward direction, and the wall's length."""
        x = self.east_west_m
        y = self.north_south_m
        return {
            "south": (Pose(x, 0.0, math.pi / 2), x),
            "north": (Pose(0.0, y, -math.pi / 2), x),
            "east": (Pose(x, y, math.pi), y),
            "west": (Pose(0.0, 0.0, 0.0), y),
        }[wall]


def _grown(piece: Furniture, distance_m: float) -> Polygon:
    """Buffer a footprint, with corners for arcs: an octagon about a circle."""
    if piece.kind in ROUND:
        radius_m = (piece.width_m / 2 + distance_m) / math.cos(math.pi / 8)
        return shapely.Point(piece.x_m, piece.y_m).buffer(radius_m, quad_segs=2)
    return piece.footprint.buffer(distance_m, join_style="mitre")


@dataclass(frozen=True, config=STRICT)
class RoomSpot:
    """Position and direction."""

    x_m: Metres
    y_m: Metres
    facing_deg: Degrees

    @property
    def pose(self) -> Pose:
        """The same in radians."""
        return Pose(self.x_m, self.y_m, math.remainder(math.radians(self.facing_deg), math.tau))


@dataclass(frozen=True, eq=False, kw_only=True, config=STRICT)
class RoomFile(Room):
    """A room with a task, the content of a room file."""

    format: Literal["smal.room/1"]
    note: Annotated[str, Field(max_length=2000)] = ""  # For readers; programs ignore it.
    # Start of the robot, scattered by 0.15 m east-west and north-south, and 15 degrees.
    start: RoomSpot
    victim: RoomSpot
    hidden: bool = True
    """Whether the victim must be hidden from every start."""

    def __post_init__(self) -> None:
        """Reject things that extend beyond the room."""
        floor = shapely.box(*self.bounds).buffer(_TOLERANCE_M)
        for number, piece in enumerate(self.furniture):
            if piece.height_m > self.walls_m or not floor.covers(piece.footprint):
                at = f"{piece.height_m:g} m high, at ({piece.x_m:g}, {piece.y_m:g}) m"
                raise ValueError(
                    f"furniture.{number} ({piece.kind}): {at}, it extends beyond the room"
                )
        for number, fitting in enumerate(self.fittings):
            wall = shapely.box(0.0, 0.0, self.wall(fitting.wall)[1], self.walls_m).buffer(
                _TOLERANCE_M
            )
            (_, left_m, _, right_m), low_m, high_m = fitting.face()
            if not wall.covers(shapely.box(left_m, low_m, right_m, high_m)):
                raise ValueError(
                    f"fittings.{number}: the {fitting.kind} extends beyond the {fitting.wall} wall"
                )
        above = self.overhead
        if above is not None and not (
            above.x_m <= self.east_west_m and above.y_m <= self.north_south_m
        ):
            raise ValueError(f"overhead: at ({above.x_m:g}, {above.y_m:g}) m outside the room")

    def world(self, path: Path) -> World:
        """Build the world of a file; raises WorldError for missing space, no route, or a visible victim."""
        world = World(replace(self, name=path.stem), self.start.pose, self.victim.pose)
        self._check_room_for("start", world.start, SCALE.start_room_m)
        self._check_room_for("victim", world.victim, _VICTIM_RADIUS_M)
        plan_route(world, (world.start.x, world.start.y))
        seen = sights(world)[obstacles_of(world.place).in_sight(sights(world))]
        if self.hidden and len(seen):
            x, y = seen[0, 0]
            raise WorldError(
                f"victim: visible from the start ({x:.2f}, {y:.2f}) m; hide it behind furniture "
                f'of at least {HIDING_M:g} m, or set "hidden": false'
            )
        return world

    def _check_room_for(self, role: str, pose: Pose, least_m: float) -> None:
        if not self._floor_off_things(least_m).covers(shapely.Point(pose.x, pose.y)):
            where = f"{role}: ({pose.x:g}, {pose.y:g}) m"
            raise WorldError(
                f"{where} is less than {least_m:g} m from the furniture or a wall, or outside the room"
            )


def sights(world: World) -> NDArray[np.float64]:
    """Return lines of sight (n, 2, 2) from a 3 by 3 grid of starts to the victim."""
    offsets = (-world.scale.start_m, 0.0, world.scale.start_m)
    starts = np.array(
        [(world.start.x + x, world.start.y + y) for x, y in itertools.product(offsets, repeat=2)]
    )
    victim = np.array([world.victim.x, world.victim.y])
    across = np.stack([victim[1] - starts[:, 1], starts[:, 0] - victim[0]], axis=1)
    across *= _VICTIM_RADIUS_M / np.maximum(
        np.linalg.norm(across, axis=1, keepdims=True), _TOLERANCE_M
    )
    return np.concatenate(
        [np.stack([starts, victim + side * across], axis=1) for side in (-1.0, 0.0, 1.0)]
    )
