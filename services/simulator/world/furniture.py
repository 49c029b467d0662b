"""What stands in a room, or in the way: a kind, a place, a size, and which parts are solid at which height."""

import math
import re
from functools import cached_property
from typing import Annotated, Final, Literal

import shapely
from pydantic import BeforeValidator, Field
from pydantic.dataclasses import dataclass
from shapely import Polygon, affinity

from services.simulator.world.place import STRICT, Rgb, Solid

FurnitureKind = Literal["cabinet", "car", "chair", "crate", "desk", "partition", "plant", "shelf", "sofa", "table"]
#: Kinds whose footprint is a circle, `width_m` across.
ROUND: Final[frozenset[FurnitureKind]] = frozenset({"plant"})
#: What is at least this high hides a victim of 0.58 m from every camera that is not higher than the victim.
HIDING_M: Final = 0.6
#: Thickness of a table's or desk's board, of a table's legs and of a desk's panels, and how deep the drawers are.
BOARD_M: Final = 0.03
LEG_M: Final = 0.06
PANEL_M: Final = 0.03
DRAWERS_M: Final = 0.42
#: How high a sofa's seat and arms are as fractions of its height, and how deep its back and how wide its arms are.
SEAT_FRACTION: Final = 0.55
ARM_FRACTION: Final = 0.75
SOFA_BACK_M: Final = 0.22
SOFA_ARM_M: Final = 0.18
#: How high a chair's seat is as a fraction of its height, and how deep its back.
CHAIR_FRACTION: Final = 0.52
CHAIR_BACK_M: Final = 0.04
#: How far a car's sills are above the ground, its bonnet as a fraction of its height, and where its cabin begins and
#: ends as fractions of its length.
SILLS_M: Final = 0.2
BONNET_FRACTION: Final = 0.58
CABIN_FRACTIONS: Final = (0.1, 0.68)
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


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Furniture:
    """A piece of furniture in a room's file; tables, desks and chairs are open below, plants round, others boxes."""

    kind: FurnitureKind
    x_m: Metres  # Middle of its footprint, from the west wall.
    y_m: Metres  # Middle of its footprint, from the south wall.
    facing_deg: Degrees = 0.0
    """Where its front looks; a shelf's front is the side with the books, a desk's the side where one sits."""
    width_m: Size  # From its left to its right side, seen from the front; the diameter of what is round.
    depth_m: Metres = 0.0  # From its front to its back; left out for what is round.
    height_m: Size  # From the floor to its top.
    colour: Colour | None = None  # Of its main surface, for instance "#7a8fa6"; left out, the usual one of its kind.

    def __post_init__(self) -> None:
        """Refuse what no such piece can be."""
        if self.kind in ROUND and self.depth_m:
            raise ValueError(f"depth_m: a {self.kind} is round and has a width_m only")
        if self.kind not in ROUND and self.depth_m < 0.02:
            raise ValueError(f"depth_m: a {self.kind} needs one, of 0.02 m or more")
        width_m, depth_m = _SMALLEST_M.get(self.kind, (0.0, 0.0))
        if self.width_m < width_m or self.depth_m < depth_m:
            raise ValueError(f"width_m, depth_m: a {self.kind} is at least {width_m:g} m wide and {depth_m:g} m deep")

    @property
    def heading(self) -> float:
        """Direction that its front faces, radians from east, anticlockwise."""
        return math.radians(self.facing_deg)

    @property
    def outline(self) -> Polygon:
        """What it covers in its own frame, x towards the front."""
        if self.kind in ROUND:
            return shapely.Point(0.0, 0.0).buffer(self.width_m / 2, quad_segs=_QUADRANT_SEGMENTS)
        return shapely.box(*self.box)

    @property
    def box(self) -> Box:
        """What it covers in its own frame, if it is not round."""
        return -self.depth_m / 2, -self.width_m / 2, self.depth_m / 2, self.width_m / 2

    @cached_property
    def footprint(self) -> Polygon:
        """What it covers, seen from above, metres."""
        return self._placed(self.outline)

    @cached_property
    def solids(self) -> tuple[Solid, ...]:
        """Its solid parts."""
        return tuple(
            Solid(self._placed(shape), low, high, opaque=low == 0.0 and high >= HIDING_M and self.kind not in ROUND)
            for shape, low, high in self._parts()
        )

    def _placed(self, shape: Polygon) -> Polygon:
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        return affinity.affine_transform(shape, [cos, -sin, sin, cos, self.x_m, self.y_m])

    def _parts(self) -> list[tuple[Polygon, float, float]]:
        """Return shape in the own frame, lower and upper height of every part."""
        under = self.height_m - BOARD_M
        match self.kind:
            case "table" | "desk":
                below = self.legs if self.kind == "table" else self.panels
                return [*((shapely.box(*box), 0.0, under) for box in below), (self.outline, under, self.height_m)]
            case "chair":
                x_min, y_min, _, y_max = self.box
                seat, back = CHAIR_FRACTION * self.height_m, shapely.box(x_min, y_min, x_min + CHAIR_BACK_M, y_max)
                legs = [(shapely.box(*box), 0.0, seat) for box in self.legs]
                return [*legs, (self.outline, seat - BOARD_M, seat), (back, seat, self.height_m)]
            case "car":
                bonnet = BONNET_FRACTION * self.height_m
                return [(self.outline, SILLS_M, bonnet), (shapely.box(*self.cabin), bonnet, self.height_m)]
            case "sofa":
                x_min, y_min, _, y_max = self.box
                back = shapely.box(x_min, y_min, x_min + SOFA_BACK_M, y_max)
                return [(back, 0.0, self.height_m), (self.outline, 0.0, self.height_m * ARM_FRACTION)]
            case _:
                return [(self.outline, 0.0, self.height_m)]

    @property
    def legs(self) -> list[Box]:
        """The four legs of a table, or of a chair, whose are half as thick."""
        thick = LEG_M / 2 if self.kind == "chair" else LEG_M
        ahead, aside = (((half - thick, half), (-half, thick - half)) for half in (self.depth_m / 2, self.width_m / 2))
        return [(x_min, y_min, x_max, y_max) for x_min, x_max in ahead for y_min, y_max in aside]

    @property
    def cabin(self) -> Box:
        """What is above the bonnet of a car."""
        behind, ahead = ((share - 0.5) * self.depth_m for share in CABIN_FRACTIONS)
        return behind, 0.06 - self.width_m / 2, ahead, self.width_m / 2 - 0.06

    @property
    def panels(self) -> tuple[Box, Box, Box]:
        """A desk's drawers under its left end, the panel under its right end, and the panel along its back."""
        x, y = self.depth_m / 2, self.width_m / 2
        drawers = min(DRAWERS_M, self.width_m / 2)
        return (-x, y - drawers, x, y), (-x, -y, x, PANEL_M - y), (-x, PANEL_M - y, PANEL_M - x, y - drawers)
