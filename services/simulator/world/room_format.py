"""The JSON format "smal.room/1": a room as people write it down, in metres and degrees.

Metres are measured from the room's south-west corner, x to the east and y to the north. Angles are anticlockwise from
east: 0 looks east, 90 north, 180 west, 270 south.
"""

from __future__ import annotations

from typing import Annotated, Final, Literal

from pydantic import Field

from schemas.base import Strict
from services.simulator.world.furniture import FurnitureKind
from services.simulator.world.room import FittingKind, FloorKind, Wall

FORMAT: Final = "smal.room/1"
Metres = Annotated[float, Field(ge=0.0, le=50.0)]
Size = Annotated[float, Field(ge=0.02, le=50.0)]
Degrees = Annotated[float, Field(ge=-360.0, le=360.0)]
Colour = Annotated[str, Field(pattern=r"^#[0-9a-fA-F]{6}$")]


class FurnitureEntry(Strict):
    """A piece of furniture."""

    kind: FurnitureKind
    """Tables and desks are open below; chairs and plants are round; the others are boxes."""
    x_m: Metres
    """Middle of its footprint, from the west wall."""
    y_m: Metres
    """Middle of its footprint, from the south wall."""
    facing_deg: Degrees = 0.0
    """Where its front looks; a shelf's front is the side with the books, a desk's the side where one sits."""
    width_m: Size
    """From its left to its right side, seen from the front; the diameter of what is round."""
    depth_m: Size | None = None
    """From its front to its back; left out for what is round."""
    height_m: Size
    """From the floor to its top."""
    colour: Colour | None = None
    """Of its main surface, for instance "#7a8fa6"; left out, the usual one of its kind."""


class FittingEntry(Strict):
    """Something flat on a wall."""

    kind: FittingKind
    """What it is."""
    wall: Wall
    """On which wall."""
    along_m: Metres
    """From the wall's left end to the middle of it, seen from inside the room."""
    foot_m: Metres
    """From the floor to its lower edge."""
    width_m: Size
    """From side to side."""
    height_m: Size
    """From its lower to its upper edge."""
    variant: Annotated[int, Field(ge=0, le=9999)] = 0
    """Which of many pictures it wears; two of a kind with the same variant and colour look the same."""
    colour: Colour | None = None
    """Of a poster's paper or a door's leaf; left out, the variant chooses."""


class PlaceEntry(Strict):
    """Where somebody stands, and where they look."""

    x_m: Metres
    """From the west wall."""
    y_m: Metres
    """From the south wall."""
    facing_deg: Degrees
    """Where they look."""


class OverheadEntry(Strict):
    """A camera that hangs above the room and looks straight down; it sees through the ceiling."""

    x_m: Metres
    """From the west wall."""
    y_m: Metres
    """From the south wall."""
    height_m: Annotated[float, Field(ge=1.0, le=100.0)]
    """Above the floor."""
    up_deg: Degrees = 90.0
    """Which direction on the floor points up in its image."""
    width_px: Annotated[int, Field(ge=64, le=4096)]
    """Width of its image."""
    height_px: Annotated[int, Field(ge=64, le=4096)]
    """Height of its image."""
    focal_px: Annotated[float, Field(ge=16.0, le=10000.0)]
    """Focal length; the image is width_px / focal_px times the height wide, on the floor."""


class RoomEntry(Strict):
    """A room with a task."""

    format: Literal["smal.room/1"]
    """Name and version of this format."""
    note: Annotated[str, Field(max_length=2000)] = ""
    """For people; nothing reads it."""
    east_west_m: Annotated[float, Field(ge=1.5, le=50.0)]
    """From the west to the east wall."""
    north_south_m: Annotated[float, Field(ge=1.5, le=50.0)]
    """From the south to the north wall."""
    walls_m: Annotated[float, Field(ge=1.0, le=10.0)] = 2.8
    """From the floor to the ceiling."""
    floor: FloorKind = "lino"
    """What the floor is covered with."""
    wall_colour: Colour = "#e6e2d8"
    """Of the walls' paint."""
    furniture: Annotated[list[FurnitureEntry], Field(max_length=200)]
    """What stands in the room."""
    fittings: Annotated[list[FittingEntry], Field(max_length=200, default_factory=list)]
    """What hangs on the walls; the robot cannot touch it."""
    start: PlaceEntry
    """Where the robot starts, up to 0.15 m east-west and north-south and 15 degrees off."""
    victim: PlaceEntry
    """Where the victim stands."""
    hidden: bool = True
    """Whether the victim must be out of sight from every start; false allows a victim that is seen at once."""
    overhead: OverheadEntry | None = None
    """The camera above, if there is one."""
