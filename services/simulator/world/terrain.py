"""An outdoor place in local metres (x east, y north), and its world file, `smal.terrain/1`.

The classes define the file format. Headings are in degrees from east, anticlockwise. World files
can be edited: to move the victim, change its x and y.
"""

import json
import math
from collections.abc import Iterator
from dataclasses import asdict, fields, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal, TypeVar

import numpy as np
import shapely
from numpy.typing import NDArray
from pydantic import Field, GetPydanticSchema
from pydantic.dataclasses import dataclass
from pydantic_core import core_schema
from shapely import LineString, Polygon
from shapely.geometry.base import BaseGeometry

from services.kit.going_on import each
from services.simulator.robots import RESCUEBOT, RobotModel
from services.simulator.world.osm import LARGEST_M, MOST_WAY_M
from services.simulator.world.place import (
    STRICT,
    OverheadMount,
    Pose,
    Scale,
    Solid,
    World,
    polygons,
)

FORMAT: Final = "smal.terrain/1"
FacadeStyle = Literal["brick", "plaster", "concrete", "glass", "wood"]
RoofShape = Literal["flat", "gabled", "hipped"]
RoadKind = Literal["street", "path"]
AreaKind = Literal["grass", "water", "paved"]
BarrierKind = Literal["hedge", "wall", "fence"]
TreeKind = Literal["round", "tall", "conifer"]

_BANK_M: Final = 0.5  # Height of the wall that represents water and the edge of the world.
POST_M: Final = 0.1  # Radius of the posts of a canopy.
# Roofs without walls stand on posts if one can walk under them, except very large roofs.
_HEADROOM_M: Final = 1.5
_CANOPY_M2: Final = 400.0
_POST_INSET_M: Final = 0.2
_MOST: Final = 50_000
_DECIMALS: Final = 3
_GRID_M: Final = 10.0**-_DECIMALS


def _line(_source: object, handler: Any) -> Any:  # noqa: ANN401 - pydantic's
    """Return pydantic's schema of a line: points in a file, else a `LineString`."""
    to_line = core_schema.no_info_plain_validator_function(_line_through)
    return core_schema.json_or_python_schema(
        json_schema=core_schema.chain_schema([handler.generate_schema(_Points), to_line]),
        python_schema=core_schema.is_instance_schema(LineString),
    )


def _line_through(points: list[tuple[float, float]]) -> LineString:
    line = LineString(points)
    if line.length == 0:
        raise ValueError("it has no length")
    return line


Coordinate = Annotated[float, Field(ge=-LARGEST_M, le=LARGEST_M)]
Point = tuple[Coordinate, Coordinate]
_Points = Annotated[list[Point], Field(min_length=2, max_length=100_000)]
Line = Annotated[LineString, GetPydanticSchema(_line)]
Thing = TypeVar("Thing")
Many = Annotated[tuple[Thing, ...], Field(max_length=_MOST, fail_fast=True)]
Ring = Annotated[tuple[Point, ...], Field(min_length=4, max_length=100_000)]
Byte = Annotated[int, Field(ge=0, le=255)]
Text = Annotated[str, Field(max_length=255)]
Counts = Annotated[dict[Text, Annotated[int, Field(ge=0, le=10**9)]], Field(max_length=1000)]


@dataclass(frozen=True, config=STRICT)
class Facade:
    """Appearance of walls; equal façades have the same picture."""

    style: FacadeStyle
    colour: tuple[Byte, Byte, Byte] | None = None
    variant: Annotated[int, Field(ge=0, lt=2**32)] = 0


@dataclass(frozen=True, eq=False, config=STRICT)
class Plan:
    """Footprint of an object: an outline and courtyards, closed rings."""

    outline: Ring
    holes: tuple[Ring, ...] = ()

    def __post_init__(self) -> None:
        """Reject rings without an area."""
        if any(ring[0] != ring[-1] for ring in (self.outline, *self.holes)):
            raise ValueError("a ring does not end where it begins")
        if not self.footprint.is_valid or self.footprint.area == 0:
            raise ValueError("its outline crosses itself or has no area")

    @cached_property
    def footprint(self) -> Polygon:
        """The footprint as one polygon."""
        return Polygon(self.outline, self.holes)


def plan(polygon: Polygon) -> dict[str, Any]:
    """Return the fields of the plan that covers a polygon."""
    outline, *holes = (tuple(ring.coords) for ring in (polygon.exterior, *polygon.interiors))
    return {"outline": outline, "holes": tuple(holes)}


def rounded_plans(polygon: Polygon) -> Iterator[dict[str, Any]]:
    """Yield the plans of a polygon in millimetres; a sliver has none, a self-touching one several."""
    rounded = shapely.transform(polygon, lambda points: np.round(points, _DECIMALS))
    if not rounded.is_valid:
        rounded = shapely.set_precision(polygon, _GRID_M)
    yield from map(plan, polygons(rounded))


@dataclass(frozen=True, eq=False, kw_only=True, config=STRICT)
class Building(Plan):
    """A footprint extruded between two heights, with a roof."""

    height_m: Annotated[float, Field(gt=0, le=500)]  # Eaves above the ground.
    min_height_m: Annotated[float, Field(ge=0, le=500)] = 0.0
    """Lower end of the walls; above 0 for canopies and over passages."""
    roof: RoofShape = "flat"
    # Ridge above the eaves; 0 for a flat roof.
    roof_height_m: Annotated[float, Field(ge=0, le=100)] = 0.0
    roof_colour: tuple[Byte, Byte, Byte] | None = None  # None if unknown.
    facade: Facade

    def __post_init__(self) -> None:
        """Reject an upper end below the lower end."""
        super().__post_init__()
        if self.min_height_m >= self.height_m:
            raise ValueError(
                f"min_height_m: {self.min_height_m} is not below height_m {self.height_m}"
            )

    @property
    def posts(self) -> NDArray[np.float64]:
        """Positions (n, 2) of the posts under a canopy's corners, metres; empty over passages."""
        if self.min_height_m <= _HEADROOM_M or self.footprint.area > _CANOPY_M2:
            return np.empty((0, 2))
        inset: BaseGeometry = self.footprint.simplify(0.5).buffer(
            -_POST_INSET_M, join_style="mitre"
        )
        return (
            shapely.get_coordinates(inset.exterior)[:-1]
            if isinstance(inset, Polygon)
            else np.empty((0, 2))
        )


@dataclass(frozen=True, eq=False, config=STRICT)
class Road:
    """A centre line with a width."""

    line: Line
    width_m: Annotated[float, Field(gt=0, le=40)]
    kind: RoadKind
    drivable: bool  # Whether routes can use it.
    marked: bool = False  # Whether it has a dashed centre line.
    sidewalks: bool = False  # Whether it has sidewalks on both sides.


@dataclass(frozen=True, eq=False, kw_only=True, config=STRICT)
class Area(Plan):
    """An area of ground."""

    kind: AreaKind


@dataclass(frozen=True, config=STRICT)
class Tree:
    """A trunk with a crown; only the trunk is an obstacle."""

    x: Coordinate
    y: Coordinate
    height_m: Annotated[float, Field(gt=0, le=100)]
    kind: TreeKind
    trunk_radius_m: Annotated[float, Field(gt=0, le=5)] = 0.2


@dataclass(frozen=True, eq=False, config=STRICT)
class Barrier:
    """A hedge, wall or fence along a line."""

    line: Line
    height_m: Annotated[float, Field(gt=0, le=50)]
    kind: BarrierKind


@dataclass(frozen=True, config=STRICT)
class Source:
    """Origin of a terrain, and import statistics of its map."""

    file: Text
    attribution: Text  # Attribution required by the map's licence.
    latitude_deg: Annotated[float, Field(ge=-90, le=90)]
    longitude_deg: Annotated[float, Field(ge=-180, le=180)]  # Position of the origin.
    used: Counts  # Number of used elements, by kind ("building", "building relation", "road", ...).
    # Number of broken elements, by kind and reason ("building: its outline is not closed").
    skipped: Counts
    left_out: Counts
    """Number of valid elements without visible effect, by kind and reason ("road: under the
    ground").
    """


@dataclass(frozen=True, eq=False, kw_only=True, config=STRICT)
class Terrain:
    """An outdoor place with all objects on the ground."""

    name: str = ""
    source: Source | None = None  # None for a terrain without a map.
    bounds: tuple[Coordinate, Coordinate, Coordinate, Coordinate]
    buildings: Many[Building]
    roads: Many[Road]
    areas: Many[Area] = ()
    trees: Many[Tree] = ()
    barriers: Many[Barrier] = ()

    #: Robot and scale of the paper's campus; no shake, no overhead camera.
    robot: ClassVar[RobotModel] = RESCUEBOT
    scale: ClassVar[Scale] = Scale()
    shake: ClassVar[float] = 0.0
    overhead: ClassVar[OverheadMount | None] = None

    @cached_property
    def solids(self) -> tuple[Solid, ...]:
        """Buildings, posts of canopies, trunks, barriers, water, and the edge of the world."""
        walls = [
            Solid(one.footprint, one.min_height_m, one.height_m, opaque=True)
            for one in self.buildings
        ]
        posts = [
            Solid(shapely.Point(place).buffer(POST_M), 0.0, building.min_height_m, opaque=False)
            for building in each(self.buildings)
            for place in building.posts
        ]
        trunks = [
            Solid(
                shapely.Point(tree.x, tree.y).buffer(tree.trunk_radius_m),
                0.0,
                tree.height_m,
                opaque=False,
            )
            for tree in self.trees
        ]
        water = [
            Solid(area.footprint, 0.0, _BANK_M, opaque=False)
            for area in self.areas
            if area.kind == "water"
        ]
        barriers = [
            Solid(barrier.line, 0.0, barrier.height_m, opaque=False) for barrier in self.barriers
        ]
        edge = Solid(shapely.box(*self.bounds).exterior, 0.0, _BANK_M, opaque=False)
        return (*walls, *posts, *trunks, *water, *barriers, edge)

    def walls_from(self, middle: shapely.Point) -> Iterator[NDArray[np.float64]]:
        """Yield the outlines (n, 2) of buildings, anticlockwise, nearest first."""
        for building in sorted(self.buildings, key=lambda one: one.footprint.distance(middle)):
            whole = shapely.orient_polygons(building.footprint)
            yield shapely.get_coordinates(whole.exterior)

    @cached_property
    def lanes(self) -> tuple[LineString, ...]:
        """Centre lines of the drivable roads."""
        return tuple(road.line for road in self.roads if road.drivable)


@dataclass(frozen=True, config=STRICT)
class Spot:
    """Position and direction."""

    x: Coordinate
    y: Coordinate
    heading_deg: Annotated[float, Field(ge=-360, le=360)] = 0.0

    @property
    def pose(self) -> Pose:
        """The same in radians."""
        return Pose(self.x, self.y, math.remainder(math.radians(self.heading_deg), math.tau))


@dataclass(frozen=True, eq=False, kw_only=True, config=STRICT)
class TerrainFile(Terrain):
    """A terrain with a task, the content of a terrain file."""

    format: Literal["smal.terrain/1"]
    start: Spot
    victim: Spot

    def __post_init__(self) -> None:
        """Reject empty and too large worlds."""
        x_min, y_min, x_max, y_max = self.bounds
        if not (x_min < x_max and y_min < y_max):
            raise ValueError("bounds: expected x_min, y_min, x_max, y_max in this order")
        if max(x_max - x_min, y_max - y_min) > LARGEST_M:
            raise ValueError(f"bounds: too large (a world spans at most {LARGEST_M / 1000:.0f} km)")
        length_m = sum(road.line.length for road in self.roads)
        if length_m > MOST_WAY_M:
            raise ValueError(
                f"roads: too long ({length_m / 1000:.0f} km > maximum {MOST_WAY_M / 1000:.0f} km)"
            )

    def world(self, path: Path) -> World:
        """Build the world of a file."""
        return World(replace(self, name=path.stem), self.start.pose, self.victim.pose)


def task_content(world: World) -> dict[str, dict[str, float]]:
    """Return start and victim of a world as a world file states them."""
    spots = {"start": world.start, "victim": world.victim}
    return {
        name: {"x": spot.x, "y": spot.y, "heading_deg": math.degrees(spot.heading)}
        for name, spot in spots.items()
    }


def terrain_text(world: World) -> str:
    """Return the file content of a terrain world, one object a line, rounded to millimetres."""
    terrain = world.place
    if not isinstance(terrain, Terrain):
        raise TypeError(f"unsupported place for {FORMAT}: {type(terrain).__name__}")
    things = asdict(_on_grid(terrain))
    names = [field.name for field in fields(Terrain) if field.name != "name"]
    content = {"format": FORMAT} | task_content(world) | {name: things[name] for name in names}
    whole = json.dumps(content, default=lambda line: line.coords[:])
    # Adding zero turns -0.0 into 0.0.
    rounded = json.loads(whole, parse_float=lambda number: round(float(number), _DECIMALS) + 0.0)
    in_a_line = partial(json.dumps, ensure_ascii=False, allow_nan=False)
    lines = []
    for key, value in rounded.items():
        text = in_a_line(value)
        if isinstance(value, list) and value and isinstance(value[0], dict):
            text = "[\n  " + ",\n  ".join(map(in_a_line, value)) + "\n ]"
        lines.append(f'"{key}": {text}')
    return "{\n " + ",\n ".join(lines) + "\n}\n"


def _on_grid(terrain: Terrain) -> Terrain:
    """Round shapes to millimetres; see `rounded_plans`."""

    def lines(line: LineString) -> Iterator[LineString]:
        rounded = shapely.set_precision(line, _GRID_M)
        if not rounded.is_empty:
            yield rounded

    return replace(
        terrain,
        buildings=tuple(
            replace(one, **some)
            for one in terrain.buildings
            for some in rounded_plans(one.footprint)
        ),
        areas=tuple(
            replace(one, **some) for one in terrain.areas for some in rounded_plans(one.footprint)
        ),
        roads=tuple(replace(one, line=line) for one in terrain.roads for line in lines(one.line)),
        barriers=tuple(
            replace(one, line=line) for one in terrain.barriers for line in lines(one.line)
        ),
    )
