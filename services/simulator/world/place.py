"""What every world is, indoors or out: a place in local metres (x east, y north) with a task in it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from shapely import LineString
    from shapely.geometry.base import BaseGeometry

    from services.simulator.robots import RobotModel

Rgb = tuple[int, int, int]


class WorldError(Exception):
    """A world cannot be used; the message is one line that names the file and the problem."""


@dataclass(frozen=True)
class Pose:
    """Where something is and where it looks: metres east and north, heading in radians from east, anticlockwise."""

    x: float
    y: float
    heading: float


@dataclass(frozen=True)
class Solid:
    """Something that stands in the way, from one height to another.

    Attributes
    ----------
    shape
        What it covers, seen from above, in metres: an area, or a line for something thin.
    low_m, high_m
        Heights of its lower and upper end.
    opaque
        Whether it hides what is behind it from a robot; trees and hedges are not counted on.
    """

    shape: BaseGeometry
    low_m: float
    high_m: float
    opaque: bool


@dataclass(frozen=True)
class Scale:
    """How far is far and how close is close in a place: metres.

    Attributes
    ----------
    spacing_m
        Between points of the graph that routes are planned on.
    clearance_m
        That a route keeps from everything solid; more than the robot's radius.
    room_m
        From solid things where a lane is not tight; tight ones are avoided.
    leg_room_m, leg_end_m
        The same off the lanes, where nothing keeps a driver in the middle, except this close to an end.
    longest_leg_m
        Off the lanes, in one straight leg.
    start_m, start_room_m
        How far starts scatter east-west and north-south, and how much room each has.
    aside_m, last_m
        How far beside the route recovery drives begin, and how long before its end none does.
    found_m
        From the victim where the robot has found it, if it also sees it.
    """

    spacing_m: float = 2.0
    clearance_m: float = 0.7
    room_m: float = 1.3
    leg_room_m: float = 1.8
    leg_end_m: float = 2.5
    longest_leg_m: float = 40.0
    start_m: float = 1.0
    start_room_m: float = 0.5
    aside_m: float = 1.5
    last_m: float = 3.0
    found_m: float = 5.0


@dataclass(frozen=True)
class OverheadMount:
    """A pinhole camera that hangs above the scene and looks straight down.

    Attributes
    ----------
    x, y, height_m
        Where it hangs, metres.
    up
        Direction on the floor that points up in its image, radians from east, anticlockwise.
    width, height
        Size of its image, pixels.
    focal_px
        Focal length, pixels; the optical axis meets the image in its middle.
    """

    x: float
    y: float
    height_m: float
    up: float
    width: int
    height: int
    focal_px: float


@dataclass(frozen=True, eq=False)
class Place(ABC):
    """A place without a task.

    Attributes
    ----------
    name
        For messages and results.
    bounds
        (x_min, y_min, x_max, y_max) in metres; the robot stays inside.
    """

    name: str
    bounds: tuple[float, float, float, float]

    @property
    @abstractmethod
    def robot(self) -> RobotModel:
        """The robot that drives here."""

    @property
    @abstractmethod
    def scale(self) -> Scale:
        """How far is far here."""

    @property
    def shake(self) -> float:
        """How much a robot's camera usually shakes when it drives here; 1 on a floor that is not quite even."""
        return 0.0

    @property
    def overhead(self) -> OverheadMount | None:
        """The camera above the scene, where there is one."""
        return None

    @property
    @abstractmethod
    def solids(self) -> tuple[Solid, ...]:
        """Everything that stands in the robot's way, or hides the victim."""

    @property
    @abstractmethod
    def lanes(self) -> tuple[LineString, ...]:
        """Where routes lead; lanes meet where they share a point."""


@dataclass(frozen=True, eq=False)
class World:
    """A place with a task: from `start`, find the victim at `victim`."""

    place: Place
    start: Pose
    victim: Pose

    @property
    def name(self) -> str:
        """The place's name."""
        return self.place.name

    @property
    def robot(self) -> RobotModel:
        """The robot that drives here."""
        return self.place.robot

    @property
    def scale(self) -> Scale:
        """How far is far here."""
        return self.place.scale
