"""What stands on and beside the way, and was not there when it was taught: boxes, barriers, parked cars, chairs."""

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Final, Literal, NamedTuple

import numpy as np
import shapely
from shapely import LineString
from shapely.affinity import affine_transform
from shapely.geometry.base import BaseGeometry
from shapely.ops import substring

from services.simulator.world.place import Place, Pose, Solid, World, WorldError
from services.simulator.world.room import Room
from services.simulator.world.route import obstacles_of, plan_route

Kind = Literal["boxes", "barrier", "car", "chair"]
Box = tuple[float, float, float, float]
"""Seen from above in the thing's own frame, metres: x_min, y_min, x_max, y_max, x ahead."""


class Part(NamedTuple):
    """An upright box of a thing, from one height to another, metres, and the material that it wears."""

    box: Box
    low_m: float
    high_m: float
    wears: str


def _middle(length_m: float, width_m: float) -> Box:
    return -length_m / 2, -width_m / 2, length_m / 2, width_m / 2


def _legs(length_m: float, width_m: float, thick_m: float, high_m: float, wears: str) -> tuple[Part, ...]:
    x, y = length_m / 2 - thick_m, width_m / 2 - thick_m
    corners = ((x, y), (x, -y), (-x, y), (-x, -y))
    return tuple(Part((a - thick_m, b - thick_m, a + thick_m, b + thick_m), 0.0, high_m, wears) for a, b in corners)


_CAR_COLOURS: Final = ("orange_plastic", "blue_plastic", "aluminium", "black_plastic")
#: A usual compact car: 4.2 m by 1.8 m, its sills 0.2 m above the ground.
_CAR_M: Final = (4.2, 1.8)
#: A barrier across a lane is a metre high outdoors; of what stands indoors a robot's camera sees over nothing lower.
_BARRIER_M: Final = {False: (0.3, 1.6, 1.0), True: (0.12, 0.7, 0.6)}
_BOX_M: Final = {False: (0.8, 0.8, 0.9), True: (0.35, 0.35, 0.45)}
#: The barrier that closes a way reaches so far to either side of it, in radii of the robot, or to a wall.
_CLOSED: Final = 12.0
#: What stays free is at most so far beside the way, in radii of the robot: the belief follows it there.
_ASIDE: Final = 4.75
_TRIES: Final = 400


@dataclass(frozen=True)
class Obstacle:
    """A thing that stands somewhere, with its front to its heading."""

    kind: Kind
    pose: Pose
    small: bool = False  # As things indoors are.
    across_m: float = 0.0  # How wide a barrier is, if not as usual.
    variant: int = 0

    @cached_property
    def parts(self) -> tuple[Part, ...]:
        """What it is made of, in its own frame."""
        match self.kind:
            case "boxes":
                length_m, width_m, high_m = _BOX_M[self.small]
                return (
                    Part(_middle(length_m, width_m), 0.0, 0.6 * high_m, "cardboard"),
                    Part(_middle(0.7 * length_m, 0.8 * width_m), 0.6 * high_m, high_m, "cardboard"),
                )
            case "barrier":
                deep_m, across_m, high_m = _BARRIER_M[self.small]
                across_m = self.across_m or across_m
                board = "orange_plastic" if self.variant % 2 else "fence"
                return (
                    Part(_middle(deep_m, across_m), 0.0, 0.15 * high_m, "black_plastic"),
                    Part(_middle(0.3 * deep_m, across_m), 0.15 * high_m, 0.6 * high_m, "white_plastic"),
                    Part(_middle(0.4 * deep_m, across_m), 0.6 * high_m, high_m, board),
                )
            case "car":
                paint = _CAR_COLOURS[self.variant % len(_CAR_COLOURS)]
                return (
                    *_legs(2.9, _CAR_M[1], 0.3, 0.35, "tyre"),
                    Part(_middle(*_CAR_M), 0.2, 0.85, paint),
                    Part((-1.7, -0.75, 0.8, 0.75), 0.85, 1.4, "dark_plastic"),
                    Part((-1.6, -0.72, 0.6, 0.72), 1.4, 1.46, paint),
                )
            case "chair":
                return (
                    *_legs(0.44, 0.44, 0.02, 0.4, "aluminium"),
                    Part(_middle(0.45, 0.45), 0.4, 0.45, "fabric"),
                    Part((-0.225, -0.2, -0.19, 0.2), 0.45, 0.85, "fabric"),
                )

    @cached_property
    def solids(self) -> tuple[Solid, ...]:
        """Its parts where they stand."""
        return tuple(
            Solid(self._placed(shapely.box(*part.box)), part.low_m, part.high_m, opaque=False) for part in self.parts
        )

    @cached_property
    def footprint(self) -> BaseGeometry:
        """What it covers, seen from above."""
        return shapely.union_all([solid.shape for solid in self.solids]).convex_hull

    def _placed(self, shape: BaseGeometry) -> BaseGeometry:
        cos, sin = math.cos(self.pose.heading), math.sin(self.pose.heading)
        return affine_transform(shape, [cos, -sin, sin, cos, self.pose.x, self.pose.y])


def stand_in_the_way(
    world: World, start: Pose, rng: np.random.Generator, count: int, *, blocked: bool = False
) -> tuple[Obstacle, ...]:
    """Return so many things that stand on and beside the way from a start to the victim, and what closes it.

    They stand on different stretches of the way, not at its ends, each so that a robot that follows the way would
    touch it, or nearly. Beside each stays a passage of twice the robot's width, no further aside than a robot knows
    its way by sight; but nothing passes where the way is closed, in its middle. Raises WorldError where there is no
    room for as many.
    """
    way = _Way(world, start)
    closing = way.closed(rng) if blocked else ()
    standing: list[Obstacle] = []
    ends = np.linspace(*way.usable, count + 1)
    for near, far in pairwise(ends):
        one = way.one(float(near), float(far), (*closing, *standing), rng)
        if one is not None:
            standing.append(one)
    if len(standing) < count:
        raise WorldError(f"{world.name}: on the way there is room for {len(standing)} of {count} obstacles")
    return (*closing, *standing)


class _Way:
    """The way of one episode, and what is solid about it."""

    def __init__(self, world: World, start: Pose) -> None:
        self._place: Place = world.place
        self._radius_m, scale = world.robot.radius_m, world.scale
        self.line = LineString(plan_route(world, (start.x, start.y)))
        #: Not where episodes begin, and not where the goal counts as found.
        first_m, last_m = 3 * scale.aside_m, self.line.length - scale.found_m - 2 * self._radius_m
        self.usable = (first_m, max(first_m, last_m))
        around = self.line.buffer(2 * _ASIDE * self._radius_m)
        top_m = world.robot.top_m
        shapes = [one.shape for one in self._place.solids if one.low_m < top_m and one.shape.intersects(around)]
        self._solid = shapely.union_all(shapes)
        self._kinds: tuple[Kind, ...] = ("boxes", "barrier", "chair")
        if not isinstance(self._place, Room):
            self._kinds = ("boxes", "barrier", "car")

    def _at(self, along_m: float) -> tuple[float, float, float]:
        """Return the place and the direction of the way."""
        (x, y), (ahead_x, ahead_y) = (
            shapely.get_coordinates(self.line.interpolate(one))[0] for one in (along_m, along_m + 0.1)
        )
        return float(x), float(y), math.atan2(ahead_y - y, ahead_x - x)

    def one(
        self, near_m: float, far_m: float, others: tuple[Obstacle, ...], rng: np.random.Generator
    ) -> Obstacle | None:
        """Return a thing on a stretch of the way that leaves a passage, or None where no place was found."""
        for _ in range(_TRIES):
            kind = self._kinds[int(rng.integers(len(self._kinds)))]
            along_m, aside, turned = rng.uniform(near_m, far_m), rng.uniform(-1.0, 1.0), rng.uniform(-0.4, 0.4)
            x, y, heading = self._at(along_m)
            made = Obstacle(kind, Pose(x, y, heading), isinstance(self._place, Room), variant=int(rng.integers(8)))
            half_m = max(abs(part.box[1]) for part in made.parts)
            # Its nearest side is where the robot would touch it, or up to half of its width further away.
            aside_m = aside * (half_m + 1.5 * self._radius_m)
            pose = Pose(x - aside_m * math.sin(heading), y + aside_m * math.cos(heading), heading + turned)
            made = Obstacle(kind, pose, made.small, variant=made.variant)
            apart = 8 * self._radius_m
            if (
                not made.footprint.intersects(self._solid)
                and all(made.footprint.distance(other.footprint) > apart for other in others)
                and self._passes(along_m, made)
            ):
                return made
        return None

    def _passes(self, along_m: float, made: Obstacle) -> bool:
        """Tell whether the middle of a passage twice as wide as the robot leads from before a thing to behind it."""
        length_m, width_m = (made.footprint.length / 2 + 4 * self._radius_m, 2 * self._radius_m)
        before, behind = max(0.0, along_m - length_m), min(self.line.length, along_m + length_m)
        stretch = substring(self.line, before, behind)
        aside = stretch.buffer(_ASIDE * self._radius_m, cap_style="flat")
        free = aside.difference(shapely.union_all([made.footprint, self._solid]).buffer(width_m))
        ends = [shapely.Point(stretch.coords[k]) for k in (0, -1)]
        return any(all(part.distance(end) < 0.05 for end in ends) for part in shapely.get_parts(free))

    def closed(self, rng: np.random.Generator) -> tuple[Obstacle, ...]:
        """Return the barriers that close the way about its middle, from wall to wall, or far to both sides."""
        near, far = self.usable
        x, y, heading = self._at(near + (far - near) * rng.uniform(0.4, 0.6))
        reach_m, small = _CLOSED * self._radius_m, isinstance(self._place, Room)
        obstacles = obstacles_of(self._place)
        steps = np.arange(0.0, reach_m, self._radius_m / 2)
        ends = []
        for side in (1.0, -1.0):
            outwards = [(x - side * d * math.sin(heading), y + side * d * math.cos(heading)) for d in steps]
            free = [obstacles.is_free(px, py, 0.0) for px, py in outwards]
            # Its end stands in the wall, so that no gap stays beside it.
            ends.append(float(steps[free.index(False)]) if False in free else reach_m)
        left_m, right_m = ends
        middle_m = (left_m - right_m) / 2
        pose = Pose(x - middle_m * math.sin(heading), y + middle_m * math.cos(heading), heading)
        return (Obstacle("barrier", pose, small, across_m=left_m + right_m, variant=1),)
