"""What stands in a room: a kind, a place, a size, and which parts of it are solid at which height."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Final, Literal

import shapely
from shapely import affinity

from services.simulator.world.place import Rgb, Solid

if TYPE_CHECKING:
    from shapely import Polygon

FurnitureKind = Literal["cabinet", "chair", "crate", "desk", "partition", "plant", "shelf", "sofa", "table"]
#: Kinds whose footprint is a circle, `width_m` across.
ROUND: Final[frozenset[FurnitureKind]] = frozenset({"chair", "plant"})
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
#: Sides of the polygon that stands for a circle.
_QUADRANT_SEGMENTS: Final = 8

Box = tuple[float, float, float, float]
"""An upright box seen from above in the furniture's own frame: x_min, y_min, x_max, y_max, x towards the front."""


@dataclass(frozen=True)
class Furniture:
    """A piece of furniture.

    Attributes
    ----------
    x, y
        Middle of its footprint, metres.
    heading
        Direction that its front faces, radians from east, anticlockwise.
    width_m, depth_m, height_m
        Seen from its front: from side to side, from front to back, and up.
    colour
        None for the usual one of its kind.
    """

    kind: FurnitureKind
    x: float
    y: float
    heading: float
    width_m: float
    depth_m: float
    height_m: float
    colour: Rgb | None = None

    @property
    def outline(self) -> Polygon:
        """What it covers in its own frame, x towards the front."""
        if self.kind in ROUND:
            return shapely.Point(0.0, 0.0).buffer(self.width_m / 2, quad_segs=_QUADRANT_SEGMENTS)
        return shapely.box(-self.depth_m / 2, -self.width_m / 2, self.depth_m / 2, self.width_m / 2)

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
        return affinity.affine_transform(shape, [cos, -sin, sin, cos, self.x, self.y])

    def _parts(self) -> list[tuple[Polygon, float, float]]:
        """Return shape in the own frame, lower and upper height of every part."""
        under = self.height_m - BOARD_M
        match self.kind:
            case "table":
                legs = [(shapely.box(*leg), 0.0, under) for leg in legs_of(self)]
                return [*legs, (self.outline, under, self.height_m)]
            case "desk":
                panels = [(shapely.box(*panel), 0.0, under) for panel in panels_of(self)]
                return [*panels, (self.outline, under, self.height_m)]
            case "sofa":
                back = shapely.box(
                    -self.depth_m / 2, -self.width_m / 2, SOFA_BACK_M - self.depth_m / 2, self.width_m / 2
                )
                return [(back, 0.0, self.height_m), (self.outline, 0.0, self.height_m * ARM_FRACTION)]
            case _:
                return [(self.outline, 0.0, self.height_m)]


def legs_of(table: Furniture) -> list[Box]:
    """Return the four legs of a table."""
    x, y = table.depth_m / 2, table.width_m / 2
    return [
        (min(front, front - ahead * LEG_M), min(side, side - left * LEG_M),
         max(front, front - ahead * LEG_M), max(side, side - left * LEG_M))
        for ahead, front in ((1, x), (-1, -x)) for left, side in ((1, y), (-1, -y))
    ]  # fmt: skip


def panels_of(desk: Furniture) -> tuple[Box, Box, Box]:
    """Return a desk's drawers under its left end, the panel under its right end, and the panel along its back."""
    x, y = desk.depth_m / 2, desk.width_m / 2
    drawers = min(DRAWERS_M, desk.width_m / 2)
    return (-x, y - drawers, x, y), (-x, -y, x, PANEL_M - y), (-x, PANEL_M - y, PANEL_M - x, y - drawers)
