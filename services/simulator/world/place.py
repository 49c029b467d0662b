"""What every world is, indoors or out: a place in local metres (x east, y north) with a task in it."""

import math
from dataclasses import dataclass, replace
from typing import Annotated, Final, NamedTuple, Protocol, TypeVar

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass as checked
from shapely import LineString, Polygon, get_parts
from shapely.affinity import affine_transform
from shapely.geometry.base import BaseGeometry

from services.kit.errors import JobError
from services.simulator.robots import DriveTrain, RobotModel

Shape = TypeVar("Shape", bound=BaseGeometry)
Rgb = tuple[int, int, int]
Bounds = tuple[float, float, float, float]
"""x_min, y_min, x_max, y_max in metres."""

#: Of what a world file holds: every field known, of its very type, and finite.
STRICT: Final = ConfigDict(
    strict=True, extra="forbid", allow_inf_nan=False, arbitrary_types_allowed=True
)


class WorldError(JobError):
    """A world cannot be used; the message is one line that names the file and the problem."""


@dataclass(frozen=True)
class Pose:
    """Where something is and where it looks: metres east and north, heading in radians from east, anticlockwise."""

    x: float
    y: float
    heading: float

    def at(self, ahead_m: float, left_m: float = 0.0) -> tuple[float, float]:
        """Return the point, metres east and north, that is so far ahead of it, and to its left."""
        cos = math.cos(self.heading)
        sin = math.sin(self.heading)
        return self.x + ahead_m * cos - left_m * sin, self.y + ahead_m * sin + left_m * cos

    def place(self, shape: Shape) -> Shape:
        """Return a shape about the origin, x ahead, where it is when it stands here."""
        cos = math.cos(self.heading)
        sin = math.sin(self.heading)
        return affine_transform(shape, [cos, -sin, sin, cos, self.x, self.y])


class Solid(NamedTuple):
    """Something that stands in the way, from one height to another."""

    shape: BaseGeometry  # What it covers, seen from above, in metres: an area, or a line for something thin.
    low_m: float
    high_m: float
    opaque: bool  # Whether it hides what is behind it from a robot; trees and hedges are not counted on.


def polygons(geometry: BaseGeometry, least_m2: float = 0.0) -> list[Polygon]:
    """Return the polygons in a geometry, and in collections in it, that are larger than an area."""
    parts = get_parts(get_parts(geometry))
    return [part for part in parts if isinstance(part, Polygon) and part.area > least_m2]


@dataclass(frozen=True)
class Scale:
    """How far is far and how close is close in a place: metres."""

    spacing_m: float = 2.0  # Between points of the graph that routes are planned on.
    clearance_m: float = (
        0.7  # That a route keeps from everything solid; more than the robot's radius.
    )
    room_m: float = 1.3  # From solid things where a lane is not tight; tight ones are avoided.
    leg_room_m: float = 1.8  # The same off the lanes, where nothing keeps a driver in the middle.
    leg_end_m: float = 2.5  # So close to the end of a leg, `leg_room_m` is not asked for.
    longest_leg_m: float = 40.0  # Off the lanes, in one straight leg.
    start_m: float = 1.0  # How far starts scatter east-west and north-south.
    start_room_m: float = 0.5  # How much room each start has.
    aside_m: float = 1.5  # How far beside the route recovery drives begin.
    last_m: float = 3.0  # So long before the route's end no recovery drive begins.
    found_m: float = 5.0  # From the victim where the robot has found it, if it also sees it.
    moved_m: float = 3.0  # From its place where a victim lies that has moved, at most.


@checked(frozen=True, config=STRICT)
class OverheadMount:
    """A pinhole camera that hangs above the scene and looks straight down; its axis meets the image in its middle."""

    x_m: Annotated[float, Field(ge=0, le=50)]
    y_m: Annotated[float, Field(ge=0, le=50)]
    height_m: Annotated[float, Field(ge=1, le=100)]
    width_px: Annotated[int, Field(ge=64, le=4096)]
    height_px: Annotated[int, Field(ge=64, le=4096)]
    focal_px: Annotated[float, Field(ge=16, le=10_000)]
    up_deg: Annotated[float, Field(ge=-360, le=360)] = 90.0
    """Direction on the floor that points up in its image, from east, anticlockwise."""


class Place(Protocol):
    """A place without a task."""

    def __hash__(self) -> int:
        """Return a hash; what is computed of a place is kept by it."""

    @property
    def name(self) -> str:
        """Its name."""

    @property
    def bounds(self) -> Bounds:
        """Its extent, metres."""

    @property
    def robot(self) -> RobotModel:
        """The robot that drives there."""

    @property
    def scale(self) -> Scale:
        """How far is far there."""

    @property
    def shake(self) -> float:
        """How much its ground shakes the camera; 1 on a floor that is not quite even."""

    @property
    def overhead(self) -> OverheadMount | None:
        """The camera above it, if there is one."""

    @property
    def solids(self) -> tuple[Solid, ...]:
        """Everything that a robot can touch."""

    @property
    def lanes(self) -> tuple[LineString, ...]:
        """Where a robot may drive; lanes meet in shared points."""


@dataclass(frozen=True, eq=False)
class World:
    """A place with a task: from `start`, find the victim at `victim`."""

    place: Place
    start: Pose
    victim: Pose
    drive: DriveTrain | None = None  # Of the robot; that of the place's if not given.

    @property
    def name(self) -> str:
        """The place's name."""
        return self.place.name

    @property
    def robot(self) -> RobotModel:
        """The robot that drives here."""
        return (
            self.place.robot if self.drive is None else replace(self.place.robot, drive=self.drive)
        )

    @property
    def scale(self) -> Scale:
        """How far is far here."""
        return self.place.scale
