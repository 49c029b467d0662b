"""An indoor place: a rectangular room with furniture, in local metres from its south-west corner."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Final, Literal

import numpy as np
import shapely
from scipy.spatial import cKDTree
from shapely import LineString, Polygon

from services.simulator.robots import TURTLEBOT, RobotModel
from services.simulator.world.furniture import ROUND, Furniture
from services.simulator.world.place import OverheadMount, Place, Rgb, Scale, Solid

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from shapely.geometry.base import BaseGeometry

FloorKind = Literal["planks", "lino", "carpet"]
FittingKind = Literal["door", "poster", "whiteboard", "window"]
Wall = Literal["south", "east", "north", "west"]
_SCALE: Final = Scale(
    spacing_m=0.25,
    clearance_m=0.26,
    room_m=0.55,
    leg_room_m=0.55,
    leg_end_m=0.5,
    longest_leg_m=1.5,
    start_m=0.15,
    start_room_m=0.24,
    aside_m=0.3,
    last_m=0.8,
    found_m=1.2,
)
# Lanes keep a little more than the distance that is asked for, so that rounding to centimetres takes none of it.
_MARGIN_M: Final = 0.02
#: How far ends of lanes are apart along straight edges and on open floor, and how long a lane is.
_APART_M: Final = 1.5
_LONGEST_LANE_M: Final = 4.5


@dataclass(frozen=True)
class Fitting:
    """Something flat on a wall.

    Attributes
    ----------
    along_m
        From the wall's left end to the middle of it, seen from inside.
    foot_m
        From the floor to its lower edge.
    variant
        Which of many pictures; equal ones look the same.
    colour
        None for what its kind and variant choose.
    """

    kind: FittingKind
    wall: Wall
    along_m: float
    foot_m: float
    width_m: float
    height_m: float
    variant: int
    colour: Rgb | None = None


@dataclass(frozen=True)
class WallFrame:
    """A wall seen from inside: where its left end is, which way is right, and how long it is."""

    left: tuple[float, float]
    right: tuple[float, float]
    length_m: float

    def at(self, along_m: float) -> tuple[float, float]:
        """Return the point of the wall so far from its left end, metres."""
        return self.left[0] + along_m * self.right[0], self.left[1] + along_m * self.right[1]


@dataclass(frozen=True)
class Look:
    """How the room itself looks."""

    floor: FloorKind
    walls: Rgb


@dataclass(frozen=True, eq=False)
class Room(Place):
    """A rectangular room.

    Attributes
    ----------
    furniture
        What stands in it.
    fittings
        What hangs on its walls.
    look
        Floor and walls.
    wall_height_m
        From the floor to the ceiling.
    mount
        The camera above, where there is one; it may hang above the ceiling, which it sees through.
    """

    furniture: tuple[Furniture, ...]
    fittings: tuple[Fitting, ...]
    look: Look
    wall_height_m: float
    mount: OverheadMount | None

    @property
    def robot(self) -> RobotModel:
        """The robot of the paper's laboratory."""
        return TURTLEBOT

    @property
    def scale(self) -> Scale:
        """Metres between furniture."""
        return _SCALE

    @property
    def shake(self) -> float:
        """How much a robot's camera usually shakes when it drives here: the paper's TurtleBot often did."""
        return 1.0

    @property
    def overhead(self) -> OverheadMount | None:
        """The camera above the room."""
        return self.mount

    @cached_property
    def solids(self) -> tuple[Solid, ...]:
        """The furniture's solid parts, and the walls."""
        walls = Solid(shapely.box(*self.bounds).exterior, 0.0, self.wall_height_m, opaque=True)
        return (*(solid for piece in self.furniture for solid in piece.solids), walls)

    @cached_property
    def lanes(self) -> tuple[LineString, ...]:
        """The visibility graph of the free floor (Lozano-Perez and Wesley 1979), without its longest lanes.

        Its nodes are the corners of the floor that is at least `Scale.clearance_m` from everything, and of the floor
        that is at least `Scale.room_m` from everything, more of them along the edges between, and a coarse grid over
        open floor. Its lanes join all pairs that are not far apart with free floor between them. Around furniture
        the shortest way on the lanes is the shortest there is. Nothing leads under tables, where the camera above
        sees no robot.
        """
        nodes = self._nodes()
        pairs = cKDTree(nodes).query_pairs(_LONGEST_LANE_M, output_type="ndarray")
        lines = np.asarray(shapely.linestrings(nodes[pairs]))
        allowed = self.floor_off_things(self.scale.clearance_m)
        shapely.prepare(allowed)
        return tuple(lines[shapely.contains_properly(allowed, lines)])

    def _nodes(self) -> NDArray[np.float64]:
        """Return the ends (n, 2) of lanes, metres, to the centimetre."""
        free, roomy = (
            self.floor_off_things(distance_m + _MARGIN_M) for distance_m in (self.scale.clearance_m, self.scale.room_m)
        )
        edges = shapely.get_coordinates(shapely.segmentize(free, _APART_M))
        x_min, y_min, x_max, y_max = self.bounds
        grid = np.meshgrid(np.arange(x_min, x_max, _APART_M), np.arange(y_min, y_max, _APART_M))
        open_floor = np.stack(grid, axis=-1).reshape(-1, 2)
        open_floor = open_floor[shapely.intersects_xy(roomy, open_floor)]
        return np.unique(np.round(np.concatenate([edges, shapely.get_coordinates(roomy), open_floor]), 2), axis=0)

    def wall_frame(self, wall: Wall) -> WallFrame:
        """Return a wall as seen from inside."""
        x_min, y_min, x_max, y_max = self.bounds
        match wall:
            case "south":
                return WallFrame((x_max, y_min), (-1.0, 0.0), x_max - x_min)
            case "north":
                return WallFrame((x_min, y_max), (1.0, 0.0), x_max - x_min)
            case "east":
                return WallFrame((x_max, y_max), (0.0, -1.0), y_max - y_min)
            case "west":
                return WallFrame((x_min, y_min), (0.0, 1.0), y_max - y_min)

    def floor_off_things(self, distance_m: float) -> BaseGeometry:
        """Return the floor that is at least `distance_m` from every footprint and wall, with corners for arcs."""
        floor = shapely.box(*self.bounds).buffer(-distance_m)
        return floor.difference(shapely.union_all([_grown(piece, distance_m) for piece in self.furniture]))


def _grown(piece: Furniture, distance_m: float) -> Polygon:
    """Return what is nearer to a footprint than a distance, with corners for arcs: an octagon about a circle."""
    if piece.kind in ROUND:
        radius_m = (piece.width_m / 2 + distance_m) / math.cos(math.pi / 8)
        return shapely.Point(piece.x, piece.y).buffer(radius_m, quad_segs=2)
    return piece.footprint.buffer(distance_m, join_style="mitre")
