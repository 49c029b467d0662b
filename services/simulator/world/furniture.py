"""What stands in a room, or in the way: a kind, a place, a size, and which parts are solid at which height."""

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
ROUND: Final[frozenset[FurnitureKind]] = frozenset(
    {"plant"}
)  # Kinds whose footprint is a circle, `width_m` across.
#: What is at least this high hides a victim of 0.58 m from every camera that is not higher than the victim.
HIDING_M: Final = 0.6
# Smallest width and depth of kinds that consist of parts.
_SMALLEST_M: Final[dict[FurnitureKind, tuple[float, float]]] = {
    "car": (1.2, 2.0), "chair": (0.3, 0.3), "desk": (0.8, 0.4), "shelf": (0.3, 0.15), "sofa": (0.8, 0.5),
    "table": (0.3, 0.3),
}  # fmt: skip
# Segments of a quarter of the polygon that stands for a circle.
_QUADRANT_SEGMENTS: Final = 8


def _rgb(colour: object) -> object:
    if not isinstance(colour, str):
        return colour
    if not re.fullmatch("#[0-9a-fA-F]{6}", colour):
        raise ValueError("expected a colour like #7a8fa6")
    return tuple(bytes.fromhex(colour[1:]))


Metres = Annotated[float, Field(ge=0, le=50)]
Size = Annotated[float, Field(ge=0.02, le=50)]
Degrees = Annotated[float, Field(ge=-360, le=360)]
Colour = Annotated[Rgb, BeforeValidator(_rgb)]

Box = tuple[float, float, float, float]
"""An upright box seen from above in the furniture's own frame: x_min, y_min, x_max, y_max, x towards the front."""
Span = tuple[float, float, float, float]


@dataclass(frozen=True)
class FurniturePart:
    """A part of a piece: an entry of the table `furniture`, which says what is in it."""

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
    """A piece of furniture in a room's file; tables, desks and chairs are open below, plants round, others boxes."""

    kind: FurnitureKind
    x_m: Metres  # Middle of its footprint, from the west wall.
    y_m: Metres  # Middle of its footprint, from the south wall.
    facing_deg: Degrees = 0.0
    """Where its front looks; a shelf's front is the side with the books, a desk's the side where one sits."""
    width_m: (
        Size  # From its left to its right side, seen from the front; the diameter of what is round.
    )
    depth_m: Metres = 0.0  # From its front to its back; left out for what is round.
    height_m: Size  # From the floor to its top.
    colour: Colour | None = (
        None  # Of its main surface, for instance "#7a8fa6"; left out, the usual one of its kind.
    )

    def __post_init__(self) -> None:
        """Refuse what no such piece can be."""
        if self.kind in ROUND and self.depth_m:
            raise ValueError(f"depth_m: a {self.kind} is round and has a width_m only")
        if self.kind not in ROUND and self.depth_m < 0.02:
            raise ValueError(f"depth_m: a {self.kind} needs one, of 0.02 m or more")
        width_m, depth_m = _SMALLEST_M.get(self.kind, (0.0, 0.0))
        if self.width_m < width_m or self.depth_m < depth_m:
            raise ValueError(
                f"width_m, depth_m: a {self.kind} is at least {width_m:g} m wide and {depth_m:g} m deep"
            )

    @property
    def pose(self) -> Pose:
        """Where its middle is, and where its front looks."""
        return Pose(self.x_m, self.y_m, math.radians(self.facing_deg))

    @cached_property
    def footprint(self) -> Polygon:
        """What it covers, seen from above, metres."""
        return self.pose.place(self._outline)

    @cached_property
    def solids(self) -> tuple[Solid, ...]:
        """Its solid parts."""
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
        """Return a part's box in the own frame, and from which height to which it goes."""
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
