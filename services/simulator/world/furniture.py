"""Furniture and obstacles: kind, pose, size, and their solid parts."""

import math
import re
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Final, Literal

import shapely
from pydantic import BeforeValidator, Field
from pydantic.dataclasses import dataclass as checked
from shapely import Polygon

from services.simulator.tables import table
from services.simulator.world.place import STRICT, Pose, Rgb, Solid

FurnitureKind = Literal[
    "cabinet", "car", "chair", "crate", "desk", "partition", "plant", "shelf", "sofa", "table"
]
# Kinds with a circular footprint of diameter `width_m`.
ROUND: Final[frozenset[FurnitureKind]] = frozenset({"plant"})
#: Minimum height that hides a victim of 0.58 m from cameras at or below the victim's height.
HIDING_M: Final = 0.6
# Minimum width and depth of kinds that consist of parts.
_SMALLEST_M: Final[dict[FurnitureKind, tuple[float, float]]] = {
    "car": (1.2, 2.0), "chair": (0.3, 0.3), "desk": (0.8, 0.4), "shelf": (0.3, 0.15), "sofa": (0.8, 0.5),
    "table": (0.3, 0.3),
}  # fmt: skip
# Segments of a quarter circle.
_QUADRANT_SEGMENTS: Final = 8


def _rgb(colour: object) -> object:
    if not isinstance(colour, str):
        return colour
    if not re.fullmatch("#[0-9a-fA-F]{6}", colour):
        raise ValueError("invalid colour; expected a value like #7a8fa6")
    return tuple(bytes.fromhex(colour[1:]))


Metres = Annotated[float, Field(ge=0, le=50)]
Size = Annotated[float, Field(ge=0.02, le=50)]
Degrees = Annotated[float, Field(ge=-360, le=360)]
Colour = Annotated[Rgb, BeforeValidator(_rgb)]

Box = tuple[float, float, float, float]
"""Top view of an upright box in the furniture's frame: x_min, y_min, x_max, y_max, x to the front.
"""
Span = tuple[float, float, float, float]


@dataclass(frozen=True)
class FurniturePart:
    """A part of a piece: an entry of the table `furniture`."""

    wears: str = ""
    own: bool = False
    colour: Rgb | None = None
    solid: bool = False
    ahead: Span = (0.0, 0.0, 1.0, 0.0)
    left: Span = (0.0, 0.0, 1.0, 0.0)
    up: Span = (0.0, 0.0, 1.0, 0.0)


PARTS: Final = table("furniture", dict[FurnitureKind, tuple[FurniturePart, ...]])


@checked(frozen=True, kw_only=True, config=STRICT)
class Furniture:
    """Furniture in a room's file; plants are round, tables, desks and chairs open below."""

    kind: FurnitureKind
    x_m: Metres  # Centre of the footprint, from the west wall.
    y_m: Metres  # Centre of the footprint, from the south wall.
    facing_deg: Degrees = 0.0
    """Direction of the front: the books of a shelf, the seat of a desk."""
    # Width seen from the front; diameter of round furniture.
    width_m: Size
    depth_m: Metres = 0.0  # From front to back; omitted for round furniture.
    height_m: Size
    # Colour of the main surface, for instance "#7a8fa6"; by default the kind's usual colour.
    colour: Colour | None = None

    def __post_init__(self) -> None:
        """Reject invalid sizes."""
        if self.kind in ROUND and self.depth_m:
            raise ValueError(f"depth_m: unsupported for a {self.kind}, which is round; use width_m")
        if self.kind not in ROUND and self.depth_m < 0.02:
            raise ValueError(f"depth_m: required for a {self.kind}, at least 0.02 m")
        width_m, depth_m = _SMALLEST_M.get(self.kind, (0.0, 0.0))
        if self.width_m < width_m or self.depth_m < depth_m:
            raise ValueError(
                f"width_m, depth_m: a {self.kind} is at least {width_m:g} m wide and {depth_m:g} m deep"
            )

    @property
    def pose(self) -> Pose:
        """Centre, and direction of the front."""
        return Pose(self.x_m, self.y_m, math.radians(self.facing_deg))

    @cached_property
    def footprint(self) -> Polygon:
        """Top view of the piece, metres."""
        return self.pose.place(self._outline)

    @cached_property
    def solids(self) -> tuple[Solid, ...]:
        """Solid parts of the piece."""
        if self.kind in ROUND:
            return (Solid(self.footprint, 0.0, self.height_m, opaque=False),)
        boxes = [self.box(part) for part in PARTS[self.kind] if part.solid]
        return tuple(
            Solid(
                self.pose.place(shapely.box(*box)),
                low,
                high,
                opaque=low == 0.0 and high >= HIDING_M,
            )
            for box, low, high in boxes
        )

    @property
    def _outline(self) -> Polygon:
        if self.kind in ROUND:
            return shapely.Point(0.0, 0.0).buffer(self.width_m / 2, quad_segs=_QUADRANT_SEGMENTS)
        return shapely.box(-self.depth_m / 2, -self.width_m / 2, self.depth_m / 2, self.width_m / 2)

    def box(self, part: FurniturePart) -> tuple[Box, float, float]:
        """Return a part's box in the furniture's frame, and its lower and upper height."""
        (x_min, x_max), (y_min, y_max), (low, high) = (
            (begin * size + begin_m, end * size + end_m)
            for (begin, begin_m, end, end_m), size in (
                (part.ahead, self.depth_m),
                (part.left, self.width_m),
                (part.up, self.height_m),
            )
        )
        x = self.depth_m / 2
        y = self.width_m / 2
        return (x_min - x, y_min - y, x_max - x, y_max - y), low, high
