"""What a world is made of: plain frozen records in local metres (x east, y north), without rendering."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from shapely import LineString, Polygon

FacadeStyle = Literal["brick", "plaster", "concrete", "glass", "wood"]
RoofShape = Literal["flat", "hipped"]
RoadKind = Literal["street", "path"]
AreaKind = Literal["grass", "water", "paved"]
BarrierKind = Literal["hedge", "wall", "fence"]
TreeKind = Literal["round", "tall", "conifer"]
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
class Facade:
    """The look of a building's walls; equal facades are painted with the very same picture."""

    style: FacadeStyle
    colour: Rgb | None
    variant: int


@dataclass(frozen=True, eq=False)
class Building:
    """A footprint pulled up to a height."""

    footprint: Polygon
    height_m: float
    facade: Facade
    roof: RoofShape


@dataclass(frozen=True, eq=False)
class Road:
    """A centre line with a width; `drivable` is whether the robot may plan along it."""

    line: LineString
    width_m: float
    kind: RoadKind
    drivable: bool
    marked: bool


@dataclass(frozen=True, eq=False)
class Area:
    """A patch of ground."""

    polygon: Polygon
    kind: AreaKind


@dataclass(frozen=True)
class Tree:
    """A trunk with a crown; only the trunk is in the robot's way."""

    x: float
    y: float
    height_m: float
    kind: TreeKind
    trunk_radius_m: float = 0.2


@dataclass(frozen=True, eq=False)
class Barrier:
    """A hedge, wall or fence along a line."""

    line: LineString
    height_m: float
    kind: BarrierKind


@dataclass(frozen=True, eq=False)
class Terrain:
    """A place without a task: everything that stands or lies on the ground.

    Attributes
    ----------
    name
        The world's name, for messages.
    bounds
        (x_min, y_min, x_max, y_max) in metres; the robot stays inside.
    skipped
        Number of elements of the file that could not be used (broken, empty or without position).
    """

    name: str
    bounds: tuple[float, float, float, float]
    buildings: tuple[Building, ...]
    roads: tuple[Road, ...]
    areas: tuple[Area, ...]
    trees: tuple[Tree, ...]
    barriers: tuple[Barrier, ...]
    skipped: int


@dataclass(frozen=True, eq=False)
class World(Terrain):
    """A terrain with a task: from `start`, find the victim lying at `victim`."""

    start: Pose
    victim: Pose
