"""An outdoor place: plain frozen records of what a map shows, in local metres (x east, y north)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Final, Literal

import numpy as np
import shapely
from shapely import Polygon

from services.kit.going_on import each
from services.simulator.robots import RESCUEBOT, RobotModel
from services.simulator.world.place import Place, Rgb, Scale, Solid

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray
    from shapely import LineString
    from shapely.geometry.base import BaseGeometry

FacadeStyle = Literal["brick", "plaster", "concrete", "glass", "wood"]
RoofShape = Literal["flat", "gabled", "hipped"]
RoadKind = Literal["street", "path"]
AreaKind = Literal["grass", "water", "paved"]
BarrierKind = Literal["hedge", "wall", "fence"]
TreeKind = Literal["round", "tall", "conifer"]
_SCALE: Final = Scale()
#: Water and the edge of the world stop the robot like a wall of this height.
_BANK_M: Final = 0.5
#: Radius of the posts of a canopy.
POST_M: Final = 0.1
# A roof without walls that one can walk under stands on posts, unless it is so large that it must hang on something.
_HEADROOM_M: Final = 1.5
_CANOPY_M2: Final = 400.0
_POST_INSET_M: Final = 0.2


@dataclass(frozen=True)
class Facade:
    """The look of a building's walls; equal facades are painted with the very same picture."""

    style: FacadeStyle
    colour: Rgb | None
    variant: int


@dataclass(frozen=True, eq=False)
class Building:
    """A footprint, possibly with courtyards, pulled up from one height to another, and a roof above.

    Attributes
    ----------
    height_m
        Of the eaves, above the ground.
    min_height_m
        Where the walls begin; above 0 for what stands on posts or bridges a passage.
    roof_height_m
        Of the ridge above the eaves; 0 for a flat roof.
    roof_colour
        None where nobody has said.
    """

    footprint: Polygon
    height_m: float
    facade: Facade
    roof: RoofShape
    min_height_m: float = 0.0
    roof_height_m: float = 0.0
    roof_colour: Rgb | None = None

    @property
    def posts(self) -> NDArray[np.float64]:
        """Where posts carry a canopy, (n, 2) metres: under its corners; none under what bridges a passage."""
        if self.min_height_m <= _HEADROOM_M or self.footprint.area > _CANOPY_M2:
            return np.empty((0, 2))
        inset: BaseGeometry = self.footprint.simplify(0.5).buffer(-_POST_INSET_M, join_style="mitre")
        return shapely.get_coordinates(inset.exterior)[:-1] if isinstance(inset, Polygon) else np.empty((0, 2))


@dataclass(frozen=True, eq=False)
class Road:
    """A centre line with a width.

    Attributes
    ----------
    drivable
        Whether the robot may plan along it.
    marked
        Whether a dashed line runs along its middle.
    sidewalks
        Whether there are sidewalks on both sides.
    """

    line: LineString
    width_m: float
    kind: RoadKind
    drivable: bool
    marked: bool
    sidewalks: bool = False


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


@dataclass(frozen=True)
class Source:
    """Where a terrain comes from, and what became of the elements of its map.

    Attributes
    ----------
    file
        Name of the map's file.
    attribution
        Whom the map's licence asks to name.
    latitude_deg, longitude_deg
        Of the point where x and y are 0.
    used
        How many elements of the map became things, by kind ("building", "building relation", "road", ...).
    skipped
        How many could not be used, by kind and reason ("building: its outline is not closed").
    left_out
        How many are as they should be but show nothing here, by kind and reason ("road: under the ground").
    """

    file: str
    attribution: str
    latitude_deg: float
    longitude_deg: float
    used: Mapping[str, int]
    skipped: Mapping[str, int]
    left_out: Mapping[str, int]


@dataclass(frozen=True, eq=False)
class Terrain(Place):
    """An outdoor place: everything that stands or lies on the ground.

    Attributes
    ----------
    skipped
        Number of elements of the file that could not be used (broken, empty or without position).
    source
        Where it comes from; None for one made otherwise than from a map.
    """

    buildings: tuple[Building, ...]
    roads: tuple[Road, ...]
    areas: tuple[Area, ...]
    trees: tuple[Tree, ...]
    barriers: tuple[Barrier, ...]
    skipped: int
    source: Source | None = None

    @property
    def robot(self) -> RobotModel:
        """The robot of the paper's campus."""
        return RESCUEBOT

    @property
    def scale(self) -> Scale:
        """Metres of streets."""
        return _SCALE

    @cached_property
    def solids(self) -> tuple[Solid, ...]:
        """Buildings, the posts of canopies, trunks, barriers, water, and the edge of the world."""
        trunks = [
            Solid(shapely.Point(tree.x, tree.y).buffer(tree.trunk_radius_m), 0.0, tree.height_m, opaque=False)
            for tree in self.trees
        ]
        water = [Solid(area.polygon, 0.0, _BANK_M, opaque=False) for area in self.areas if area.kind == "water"]
        barriers = [Solid(barrier.line, 0.0, barrier.height_m, opaque=False) for barrier in self.barriers]
        walls = [
            Solid(building.footprint, building.min_height_m, building.height_m, opaque=True)
            for building in self.buildings
        ]
        posts = [
            Solid(shapely.Point(place).buffer(POST_M), 0.0, building.min_height_m, opaque=False)
            for building in each(self.buildings)
            for place in building.posts
        ]
        edge = Solid(shapely.box(*self.bounds).exterior, 0.0, _BANK_M, opaque=False)
        return (*walls, *posts, *trunks, *water, *barriers, edge)

    @cached_property
    def lanes(self) -> tuple[LineString, ...]:
        """The middles of the roads that a robot may drive on."""
        return tuple(road.line for road in self.roads if road.drivable)
