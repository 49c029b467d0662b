"""What a terrain's world file holds, field by field: `smal.terrain/1`.

Lengths are in metres with three decimals, x to the east and y to the north of the origin; headings are in degrees from
east, anticlockwise. A person may edit it: to move the victim, change its x and y.
"""

from __future__ import annotations

from typing import Annotated, Final, Literal

from pydantic import BaseModel, ConfigDict, Field

from services.simulator.world.osm_limits import LARGEST_M
from services.simulator.world.terrain import AreaKind, BarrierKind, FacadeStyle, RoadKind, RoofShape, TreeKind

FORMAT: Final = "smal.terrain/1"
_MOST: Final = 50_000

Coordinate = Annotated[float, Field(ge=-LARGEST_M, le=LARGEST_M)]
Point = Annotated[list[Coordinate], Field(min_length=2, max_length=2)]
Line = Annotated[list[Point], Field(min_length=2, max_length=100_000)]
Ring = Annotated[list[Point], Field(min_length=4, max_length=100_000)]
Byte = Annotated[int, Field(ge=0, le=255)]
Colour = Annotated[list[Byte], Field(min_length=3, max_length=3)]
Text = Annotated[str, Field(max_length=255)]
Counts = Annotated[dict[Text, Annotated[int, Field(ge=0, le=10**9)]], Field(max_length=1000)]


class Record(BaseModel):
    """A part of the file: every field known, of its very type and within its bounds."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)


class PoseRecord(Record):
    """Where something is and where it looks."""

    x: Coordinate
    y: Coordinate
    heading_deg: Annotated[float, Field(ge=-360, le=360)] = 0.0


class FacadeRecord(Record):
    """The look of walls; equal ones are painted alike."""

    style: FacadeStyle
    colour: Colour | None = None
    variant: Annotated[int, Field(ge=0, le=10_000)]


class BuildingRecord(Record):
    """A footprint with courtyards, pulled up; rings end where they begin."""

    outline: Ring
    holes: list[Ring] = []
    height_m: Annotated[float, Field(gt=0, le=500)]
    min_height_m: Annotated[float, Field(ge=0, le=500)] = 0.0
    roof: RoofShape = "flat"
    roof_height_m: Annotated[float, Field(ge=0, le=100)] = 0.0
    roof_colour: Colour | None = None
    facade: FacadeRecord


class RoadRecord(Record):
    """A centre line with a width."""

    line: Line
    width_m: Annotated[float, Field(gt=0, le=40)]
    kind: RoadKind
    drivable: bool
    marked: bool = False
    sidewalks: bool = False


class AreaRecord(Record):
    """A patch of ground."""

    outline: Ring
    holes: list[Ring] = []
    kind: AreaKind


class TreeRecord(Record):
    """A trunk with a crown."""

    x: Coordinate
    y: Coordinate
    height_m: Annotated[float, Field(gt=0, le=100)]
    kind: TreeKind
    trunk_radius_m: Annotated[float, Field(gt=0, le=5)] = 0.2


class BarrierRecord(Record):
    """A hedge, wall or fence."""

    line: Line
    height_m: Annotated[float, Field(gt=0, le=50)]
    kind: BarrierKind


class SourceRecord(Record):
    """Where the terrain comes from, and what became of its map's elements."""

    file: Text
    attribution: Text
    latitude_deg: Annotated[float, Field(ge=-90, le=90)]
    longitude_deg: Annotated[float, Field(ge=-180, le=180)]
    used: Counts
    skipped: Counts
    left_out: Counts


class TerrainRecord(Record):
    """The whole file."""

    format: Literal["smal.terrain/1"]
    source: SourceRecord | None = None
    bounds: Annotated[list[Coordinate], Field(min_length=4, max_length=4)]
    start: PoseRecord
    victim: PoseRecord
    buildings: Annotated[list[BuildingRecord], Field(max_length=_MOST)]
    roads: Annotated[list[RoadRecord], Field(max_length=_MOST)]
    areas: Annotated[list[AreaRecord], Field(max_length=_MOST)] = []
    trees: Annotated[list[TreeRecord], Field(max_length=_MOST)] = []
    barriers: Annotated[list[BarrierRecord], Field(max_length=_MOST)] = []
