"""Common model of worlds: a place in local metres (x east, y north) with a task."""

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

#: World files: unknown fields, other types and non-finite numbers are invalid.
STRICT: Final = ConfigDict(
    strict=True, extra="forbid", allow_inf_nan=False, arbitrary_types_allowed=True
)


class WorldError(JobError):
    """A world is unusable; the message is one line with the file and the problem."""


@dataclass(frozen=True)
class Pose:
    """Position in metres (east, north), and heading in radians from east, anticlockwise."""

    x: float
    y: float
    heading: float

    def at(self, ahead_m: float, left_m: float = 0.0) -> tuple[float, float]:
        """Return the point at a distance ahead and to the left, metres."""
        cos = math.cos(self.heading)
        sin = math.sin(self.heading)
        return self.x + ahead_m * cos - left_m * sin, self.y + ahead_m * sin + left_m * cos

    @property
    def turned_round(self) -> "Pose":
        """The same position, facing back."""
        return replace(self, heading=math.remainder(self.heading + math.pi, math.tau))

    def place(self, shape: Shape) -> Shape:
        """Transform a shape from the origin (x ahead) to this pose."""
        cos = math.cos(self.heading)
        sin = math.sin(self.heading)
        return affine_transform(shape, [cos, -sin, sin, cos, self.x, self.y])


class Solid(NamedTuple):
    """A solid obstacle between two heights."""

    shape: BaseGeometry  # Top view in metres: an area, or a line for a thin obstacle.
    low_m: float
    high_m: float
    opaque: bool  # Whether it blocks the robot's view; trees and hedges do not count.


def polygons(geometry: BaseGeometry, least_m2: float = 0.0) -> list[Polygon]:
    """Return the polygons of a geometry (and its collections) larger than an area."""
    parts = get_parts(get_parts(geometry))
    return [part for part in parts if isinstance(part, Polygon) and part.area > least_m2]


@dataclass(frozen=True)
class Scale:
    """Typical distances of a place, metres."""

    spacing_m: float = 2.0  # Spacing of points in the route graph.
    # Clearance of routes from solid things; greater than the robot's radius.
    clearance_m: float = 0.7
    room_m: float = 1.3  # Preferred clearance on lanes; tighter lanes cost more.
    lane_end_m: float = 4.0  # Spacing of lane ends along edges and on open floor.
    leg_room_m: float = 1.8  # Preferred clearance off the lanes, where no lane centres the driver.
    # Distance from the end of a leg below which `leg_room_m` does not apply.
    leg_end_m: float = 2.5
    longest_leg_m: float = 40.0  # Maximum length of a straight leg off the lanes.
    start_m: float = 1.0  # Scatter of starts, east-west and north-south.
    start_room_m: float = 0.5  # Free radius around each start.
    aside_m: float = 1.5  # Maximum offset of recovery starts from the route.
    last_m: float = 3.0  # End of the route without recovery starts.
    found_m: float = 5.0  # Distance at which a visible victim counts as found.
    moved_m: float = 3.0  # Maximum displacement of a moved victim.


@checked(frozen=True, config=STRICT)
class OverheadMount:
    """A pinhole camera above the scene that points straight down."""

    x_m: Annotated[float, Field(ge=0, le=50)]
    y_m: Annotated[float, Field(ge=0, le=50)]
    height_m: Annotated[float, Field(ge=1, le=100)]
    width_px: Annotated[int, Field(ge=64, le=4096)]
    height_px: Annotated[int, Field(ge=64, le=4096)]
    focal_px: Annotated[float, Field(ge=16, le=10_000)]
    up_deg: Annotated[float, Field(ge=-360, le=360)] = 90.0
    """Direction on the floor that is up in the image, from east, anticlockwise."""


class Place(Protocol):
    """Interface of a place without a task."""

    def __hash__(self) -> int:
        """Return a hash; caches use the place as key."""

    @property
    def name(self) -> str:
        """Name of the place."""

    @property
    def bounds(self) -> Bounds:
        """Extent, metres."""

    @property
    def robot(self) -> RobotModel:
        """Model of the robot in this place."""

    @property
    def scale(self) -> Scale:
        """Typical distances."""

    @property
    def shake(self) -> float:
        """Factor of the camera shake; 1 for a slightly uneven floor."""

    @property
    def overhead(self) -> OverheadMount | None:
        """Overhead camera, if present."""

    @property
    def solids(self) -> tuple[Solid, ...]:
        """Everything that a robot can touch."""

    @property
    def lanes(self) -> tuple[LineString, ...]:
        """Lines that a robot can drive along; lanes meet in shared points."""


@dataclass(frozen=True, eq=False)
class World:
    """A place with a task: find the victim at `victim` from `start`."""

    place: Place
    start: Pose
    victim: Pose
    drive: DriveTrain | None = None  # Drive of the robot; by default the place's.

    @property
    def name(self) -> str:
        """Name of the place."""
        return self.place.name

    @property
    def robot(self) -> RobotModel:
        """Model of the robot."""
        return (
            self.place.robot if self.drive is None else replace(self.place.robot, drive=self.drive)
        )

    @property
    def scale(self) -> Scale:
        """Typical distances."""
        return self.place.scale
