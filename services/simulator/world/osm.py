"""Read an OpenStreetMap XML file into nodes, ways and multipolygon relations in local metres."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
import osmium
import shapely
from shapely import LineString

from schemas.codec import printable
from services.simulator.world import osm_limits
from services.simulator.world.osm_limits import LARGEST_M, LONGEST_TAG, MOST_WAY_M
from services.simulator.world.outlines import OutlineError, area_of_rings
from services.simulator.world.place import WorldError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from numpy.typing import NDArray
    from shapely.geometry.base import BaseGeometry

    from services.simulator.world.kinds import Tags

# WGS84: semi-major axis in metres and first eccentricity squared.
_SEMI_MAJOR_M: Final = 6_378_137.0
_ECCENTRICITY_SQUARED: Final = 6.694_379_990_14e-3
# What is cut into pieces of a few metres, or made as wide as it is; outlines cost what they have corners.
_LINEAR_KEYS: Final = frozenset({"highway", "barrier", "waterway", "natural"})
_SMALLEST_M: Final = 1.0
# About the outermost thing of a map without bounds.
_BEYOND_M: Final = 10.0
# Tags that say nothing of what an area is.
_FORMAL_KEYS: Final = frozenset({"type", "source", "created_by", "note", "fixme", "FIXME"})


@dataclass(frozen=True)
class Surroundings:
    """The part of a file to read: a square about a place on the earth."""

    latitude_deg: float
    longitude_deg: float
    radius_m: float


@dataclass(frozen=True)
class OsmNode:
    """A tagged point; `xy` is (2,) in metres."""

    id: int
    xy: NDArray[np.float64]
    tags: Tags


@dataclass(frozen=True)
class OsmWay:
    """A tagged line; `points` is (n, 2) in metres, n at least 2."""

    id: int
    points: NDArray[np.float64]
    tags: Tags


@dataclass(frozen=True)
class OsmArea:
    """A tagged multipolygon relation; `area` is valid, in metres, with holes."""

    id: int
    area: BaseGeometry
    tags: Tags


@dataclass(frozen=True)
class Unread:
    """An element that became none of the above, what its tags say, and why in a few words."""

    tags: Tags
    reason: str


@dataclass(frozen=True)
class OsmExtract:
    """The tagged content of a file, centred on the middle of its bounds.

    Attributes
    ----------
    bounds
        (x_min, y_min, x_max, y_max) in metres.
    nodes, ways, areas
        What could be read.
    broken
        Ways and relations that could not.
    repeated
        Ways that are drawn as part of a relation.
    latitude_deg, longitude_deg
        Where x and y are 0.
    """

    bounds: tuple[float, float, float, float]
    nodes: tuple[OsmNode, ...]
    ways: tuple[OsmWay, ...]
    areas: tuple[OsmArea, ...]
    broken: tuple[Unread, ...]
    repeated: tuple[Unread, ...]
    latitude_deg: float
    longitude_deg: float


class _Collector:
    """Gather elements in degrees while the file streams by."""

    def __init__(self) -> None:
        self.nodes: list[tuple[int, tuple[float, float], dict[str, str]]] = []
        self.ways: dict[int, tuple[NDArray[np.float64], dict[str, str]]] = {}
        self.relations: list[tuple[int, list[tuple[int, str]], dict[str, str]]] = []
        self.broken: list[Unread] = []
        self.broken_ways: set[int] = set()
        self._points = 0

    def node(self, node: osmium.osm.Node) -> None:
        if len(node.tags) and node.location.valid():
            self.nodes.append((node.id, (node.location.lon, node.location.lat), _tags(node)))
            self._count(0)

    def way(self, way: osmium.osm.Way) -> None:
        tags, size = _tags(way), len(way.nodes)
        self._count(size)
        reason = None
        if size > osm_limits.MOST_POINTS_OF_A_WAY:
            reason = f"it has more than {osm_limits.MOST_POINTS_OF_A_WAY} points"
        else:
            places = [(ref.location.lon, ref.location.lat) for ref in way.nodes if ref.location.valid()]
            # A way that lost a corner would be drawn as another shape, so it is left out and counted.
            if len(places) < max(2, size):
                reason = "a point of it is missing" if len(places) < size else "it has fewer than two points"
            elif way.id not in self.ways:
                self.ways[way.id] = np.array(places), tags
        if reason is not None:
            self.broken_ways.add(way.id)
            if tags:
                self.broken.append(Unread(tags, reason))

    def relation(self, relation: osmium.osm.Relation) -> None:
        tags = _tags(relation)
        if tags.get("type") == "multipolygon":
            members = [(member.ref, member.role) for member in relation.members if member.type == "w"]
            self.relations.append((relation.id, members, tags))
            self._count(len(members))

    def _count(self, points: int) -> None:
        self._points += points
        if self._points > osm_limits.MOST_POINTS:
            raise _TooLargeError(f"more than {osm_limits.MOST_POINTS:,} points; cut it smaller")
        if len(self.nodes) + len(self.ways) + len(self.relations) > osm_limits.MOST_ELEMENTS:
            raise _TooLargeError(f"more than {osm_limits.MOST_ELEMENTS:,} nodes and ways; cut it smaller")


class _TooLargeError(Exception):
    """There is more in a file than a world can have."""


def read_osm(path: Path, around: Surroundings | None = None) -> OsmExtract:
    """Read an OpenStreetMap XML file.

    Parameters
    ----------
    path
        A file as exported by openstreetmap.org. Its `<bounds>` set the origin; without them, the extent of
        what is tagged does.
    around
        Read only this part of it, whose middle is the origin.

    Raises
    ------
    WorldError
        The file cannot be read, is not OpenStreetMap XML, defines entities, is cut short, holds no located element,
        or is too large.
    """
    collector = _Collector()
    try:
        osm_limits.check_file(path)
        processor = osmium.FileProcessor(osmium.io.File(str(path), "osm")).with_locations()
        for element in processor:
            if isinstance(element, osmium.osm.Node):
                collector.node(element)
            elif isinstance(element, osmium.osm.Way):
                collector.way(element)
            elif isinstance(element, osmium.osm.Relation):
                collector.relation(element)
        box = processor.header.box()
    except _TooLargeError as error:
        raise WorldError(f"{path}: {error}") from None
    except (RuntimeError, OSError, ValueError, osmium.InvalidLocationError) as error:
        raise WorldError(f"{path}: not a readable OpenStreetMap XML file ({printable(str(error))})") from error
    degrees = _square(around) if around is not None else _degree_bounds(collector, box)
    if degrees is None:
        raise WorldError(f"{path}: the file holds no located nodes or ways")
    extract = _to_metres(collector, degrees)
    _check_size(extract, path)
    return extract


def _tags(element: osmium.osm.Node | osmium.osm.Way | osmium.osm.Relation) -> dict[str, str]:
    return dict(element.tags)


def _check_size(extract: OsmExtract, path: Path) -> None:
    x_min, y_min, x_max, y_max = extract.bounds
    if min(x_max - x_min, y_max - y_min) < _SMALLEST_M:
        raise WorldError(f"{path}: the map's bounds enclose nothing")
    extent_m = max(x_max - x_min, y_max - y_min)
    if extent_m > LARGEST_M:
        raise WorldError(
            f"{path}: spans {extent_m / 1000:.0f} km; a world spans at most {LARGEST_M / 1000:.0f} km, "
            "import a part of it with --around"
        )
    lines = [LineString(way.points) for way in extract.ways if not _LINEAR_KEYS.isdisjoint(way.tags)]
    length_m = sum(shapely.clip_by_rect(line, *extract.bounds).length for line in lines)
    if length_m > MOST_WAY_M:
        raise WorldError(
            f"{path}: {length_m / 1000:.0f} km of roads, barriers and waterways, "
            f"a world has at most {MOST_WAY_M / 1000:.0f} km"
        )
    tags = [node.tags for node in extract.nodes] + [way.tags for way in extract.ways]
    tags += [area.tags for area in extract.areas]
    if any(len(value) > LONGEST_TAG for some in tags for value in some.values()):
        raise WorldError(f"{path}: a tag is longer than the {LONGEST_TAG} characters that OpenStreetMap allows")


def _square(around: Surroundings) -> NDArray[np.float64]:
    middle = np.array([around.longitude_deg, around.latitude_deg])
    reach = around.radius_m / metres_per_degree(around.latitude_deg)
    return np.array([middle - reach, middle + reach])


def _degree_bounds(collector: _Collector, box: osmium.osm.Box) -> NDArray[np.float64] | None:
    """Return [[lon_min, lat_min], [lon_max, lat_max]], from the header where it has them."""
    if box.valid():
        corners = box.bottom_left, box.top_right
        return np.array([[corner.lon, corner.lat] for corner in corners])
    places = [np.array([place]) for _, place, _ in collector.nodes]
    places += [points for points, tags in collector.ways.values() if tags]
    if not places:
        return None
    every = np.concatenate(places)
    low, high = every.min(axis=0), every.max(axis=0)
    # The robot cannot go beyond the bounds, so that a road along them could not be driven.
    margin = _BEYOND_M / metres_per_degree(float((low + high)[1]) / 2)
    return np.array([low - margin, high + margin])


def _to_metres(collector: _Collector, degrees: NDArray[np.float64]) -> OsmExtract:
    origin = degrees.mean(axis=0)
    scale = metres_per_degree(float(origin[1]))
    low, high = (degrees - origin) * scale
    lines = {way_id: ((points - origin) * scale, tags) for way_id, (points, tags) in collector.ways.items()}
    broken = list(collector.broken)
    assembled = _Relations(lines, collector.broken_ways)
    areas = [found for relation in collector.relations if (found := assembled.area_of(*relation, broken)) is not None]
    return OsmExtract(
        bounds=(float(low[0]), float(low[1]), float(high[0]), float(high[1])),
        nodes=tuple(OsmNode(i, (np.array(place) - origin) * scale, tags) for i, place, tags in collector.nodes),
        ways=tuple(_tagged_ways(lines, assembled.drawn)),
        areas=tuple(areas),
        broken=tuple(broken),
        repeated=tuple(Unread(lines[way_id][1], "drawn with its relation") for way_id in sorted(assembled.drawn)),
        latitude_deg=float(origin[1]),
        longitude_deg=float(origin[0]),
    )


def _tagged_ways(lines: Mapping[int, tuple[NDArray[np.float64], dict[str, str]]], drawn: set[int]) -> Iterator[OsmWay]:
    for way_id, (points, tags) in lines.items():
        if tags and way_id not in drawn:
            yield OsmWay(way_id, points, tags)


class _Relations:
    """Put the areas of relations together; `drawn` are the tagged ways that such an area draws already."""

    def __init__(self, lines: Mapping[int, tuple[NDArray[np.float64], dict[str, str]]], broken_ways: set[int]) -> None:
        self._lines = lines
        self._broken = broken_ways
        self._points = 0
        self.drawn: set[int] = set()

    def area_of(
        self, relation_id: int, members: list[tuple[int, str]], tags: dict[str, str], broken: list[Unread]
    ) -> OsmArea | None:
        """Return a relation's area, or None and note why it has none."""
        roles = dict(members)
        known = {ref: role for ref, role in roles.items() if ref in self._lines}
        outer = [ref for ref, role in known.items() if role != "inner"]
        tags = self._meaning(tags, outer)
        try:
            if any(ref in self._broken for ref in roles):
                raise OutlineError("a member of it is broken")
            if len(known) < len(roles):
                raise OutlineError("a member of it is not in the file")
            self._points += sum(len(self._lines[ref][0]) for ref in known)
            if self._points > osm_limits.MOST_POINTS:
                raise OutlineError("the file's relations have too many points")
            lines = {ref: LineString(self._lines[ref][0]) for ref in known}
            inner = [lines[ref] for ref, role in known.items() if role == "inner"]
            area = area_of_rings([lines[ref] for ref in outer], inner)
        except OutlineError as error:
            broken.append(Unread(tags, str(error)))
            return None
        self.drawn.update(ref for ref in outer if _says_the_same(self._lines[ref][1], tags))
        return OsmArea(relation_id, area, tags)

    def _meaning(self, tags: dict[str, str], outer: list[int]) -> dict[str, str]:
        """Return a relation's tags; those of its outer ways where it has none, as maps had it until 2017."""
        if tags.keys() - _FORMAL_KEYS:
            return tags
        return next((self._lines[ref][1] for ref in outer if self._lines[ref][1].keys() - _FORMAL_KEYS), tags)


def _says_the_same(way_tags: Tags, area_tags: Tags) -> bool:
    """Return whether an outer way is another drawing of its relation: of the same kind of thing, or of nothing else."""
    kinds = ("building", "building:part", "natural", "landuse", "leisure", "waterway", "amenity")
    return any(key in way_tags and key in area_tags for key in kinds) or way_tags == area_tags


def metres_per_degree(latitude_deg: float) -> NDArray[np.float64]:
    """Return metres per degree of longitude and of latitude on the ellipsoid; exact to 0.1 % over a few kilometres."""
    latitude = math.radians(latitude_deg)
    flat = 1.0 - _ECCENTRICITY_SQUARED * math.sin(latitude) ** 2
    prime_vertical = _SEMI_MAJOR_M / math.sqrt(flat)
    meridian = _SEMI_MAJOR_M * (1.0 - _ECCENTRICITY_SQUARED) / flat**1.5
    return math.radians(1.0) * np.array([prime_vertical * math.cos(latitude), meridian], dtype=np.float64)
