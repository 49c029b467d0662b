"""Read nodes, ways and multipolygon relations from an OpenStreetMap file, in local metres.

The content decides the format: XML, also as gzip or bzip2, PBF or o5m. What a user of JOSM deleted
is left out.
"""

import bz2
import gzip
import math
import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from io import BufferedIOBase
from pathlib import Path
from typing import Any, Final, Generic, NamedTuple, TypeVar

import numpy as np
import osmium
import shapely
from numpy.typing import NDArray
from shapely import LineString, MultiPolygon, STRtree
from shapely.geometry.base import BaseGeometry

from schemas.codec import printable
from services.kit.world_files import LARGEST_MAP
from services.simulator.world.place import Bounds, WorldError, polygons

Tags = Mapping[str, str]
Points = NDArray[np.float64]
Shape = TypeVar("Shape")

# Maximum number of points in ways and relations, and of tagged nodes, ways and relations.
MOST_POINTS: Final = 1_000_000
MOST_ELEMENTS: Final = 200_000
MOST_NODES: Final = 2_000_000  # Half a gigabyte of memory.
#: OpenStreetMap's own limits; only handmade files exceed them.
MOST_POINTS_OF_A_WAY: Final = 2_000
LONGEST_TAG: Final = 255
#: Memory limit: roads become points a couple of metres apart.
LARGEST_M: Final = 10_000.0
MOST_WAY_M: Final = 500_000.0  # Roads, barriers and waterways.

# WGS84: semi-major axis in metres and first eccentricity squared.
_SEMI_MAJOR_M: Final = 6_378_137.0
_ECCENTRICITY_SQUARED: Final = 6.694_379_990_14e-3
# Elements that are split or widened at a cost of their length; outlines cost by their corners.
_LINEAR_KEYS: Final = frozenset({"highway", "barrier", "waterway", "natural"})
_SMALLEST_M: Final = 1.0
# Margin around the elements of a map without bounds.
_BEYOND_M: Final = 10.0
#: Formats of osmium by the first bytes of a file; others are XML.
_FORMATS: Final = {b"\x1f\x8b": "osm.gz", b"BZh": "osm.bz2", b"\xff\xe0\x04": "o5m"}
_PBF: Final = b"OSMHeader"
#: Files that are not maps, and what to do.
_OTHERS: Final = {
    b"PK\x03\x04": "a ZIP archive; unpack it first",
    b"7z\xbc\xaf": "a 7z archive; unpack it first",
    b"\xfd7zXZ": "an xz archive; unpack it first",
    b"{": "JSON; ask Overpass for XML with [out:xml]",
    b"<!DOCTYPE html": "a web page; download the map itself",
    b"<html": "a web page; download the map itself",
}
_XML: Final[dict[str, Callable[[Path], BufferedIOBase]]] = {
    "osm": lambda path: path.open("rb"),
    "osm.gz": gzip.GzipFile,
    "osm.bz2": bz2.BZ2File,
}
#: JOSM writes an element on a line; libosmium ignores the attribute "action".
_DELETED: Final = re.compile(
    rb"""<(node|way|relation)\b(?=[^>]*\bid=["'](-?\d+)["'])[^>]*\baction=["']delete["']"""
)
OPEN: Final = "its outline is not closed"
_BROKEN_RINGS: Final = "its rings do not close or cross each other"
# Tags of the kind of an area.
_KIND_KEYS: Final = frozenset(
    {"building", "building:part", "natural", "landuse", "leisure", "waterway", "amenity"}
)


class OutlineError(ValueError):
    """Points do not enclose an area; the message is the reason, and follows the element's name."""


class MapSurroundings(NamedTuple):
    """The part of a file to read: a square about a position."""

    latitude_deg: float
    longitude_deg: float
    radius_m: float


class Element(NamedTuple, Generic[Shape]):
    """A tagged node (2,), a way (n, 2), or the area of a multipolygon, in metres."""

    id: int
    shape: Shape
    tags: Tags


class Unread(NamedTuple):
    """An element that was not converted, and a short reason."""

    tags: Tags
    reason: str


class Extract(NamedTuple):
    """Tagged content of a file, in metres about the middle of its bounds."""

    bounds: Bounds
    latitude_deg: float
    longitude_deg: float
    nodes: list[Element[Points]]
    ways: list[Element[Points]]
    relations: list[Element[BaseGeometry]]
    broken: list[Unread]  # Ways and relations that could not be read.
    repeated: list[Unread]  # Ways that repeat a relation.


def read_osm(path: Path, around: MapSurroundings | None = None) -> Extract:
    """Read an OpenStreetMap file, or its part `around` a position.

    Raises
    ------
    WorldError
        The file is unreadable, too large or empty.
    """
    try:
        form = _format(path)
        found = _Found()
        box = found.read(path, form)
        degrees = found.bounds(box) if around is None else found.square(around)
        extract = found.extract(degrees)
        _check_size(extract)
    except WorldError as error:
        raise WorldError(f"{path}: {error}") from None
    except (
        RuntimeError, OSError, ValueError, EOFError, zlib.error, osmium.InvalidLocationError,
    ) as error:  # fmt: skip
        raise WorldError(
            f"{path}: not a readable OpenStreetMap file ({printable(str(error))})"
        ) from error
    return extract


class _Found:
    """Elements in degrees, collected while streaming the file."""

    def __init__(self) -> None:
        self._places: dict[int, tuple[float, float]] = {}
        self._nodes: list[tuple[int, tuple[float, float], Tags]] = []
        self._refs: dict[int, tuple[NDArray[np.int64], Tags]] = {}
        self._ways: dict[int, tuple[NDArray[np.float64], Tags]] = {}
        self._relations: list[tuple[int, dict[int, str], Tags]] = []
        self._broken: list[Unread] = []
        self._broken_ways: set[int] = set()
        self._points = 0
        self._first_deg: float | None = None

    def read(self, path: Path, form: str) -> osmium.osm.Box:
        deleted = _deleted(path, form)
        processor = osmium.FileProcessor(osmium.io.File(str(path), form))
        for element in processor:
            if isinstance(element, osmium.osm.Changeset) or not element.visible:
                continue
            if (element.type_str(), element.id) not in deleted:
                self._take(element, dict(element.tags) if len(element.tags) else {})
        for number, (refs, tags) in self._refs.items():
            self._way(number, refs, tags)
        return processor.header.box()

    def _take(self, element: osmium.osm.OSMObject[Any], tags: Tags) -> None:
        if isinstance(element, osmium.osm.Node):
            self._node(element, tags)
        elif isinstance(element, osmium.osm.Way):
            refs = np.array([ref.ref for ref in element.nodes], dtype=np.int64)
            self._refs[element.id] = refs, tags
            self._points += refs.size
        elif isinstance(element, osmium.osm.Relation):
            self._relation(element, tags)
        self._check_size()

    def _check_size(self) -> None:
        tagged = len(self._nodes) + len(self._refs) + len(self._relations)
        if len(self._places) > MOST_NODES:
            raise WorldError(f"too large (more than {MOST_NODES:,} nodes); cut it smaller")
        if self._points > MOST_POINTS:
            raise WorldError(f"too large (more than {MOST_POINTS:,} points); cut it smaller")
        if tagged > MOST_ELEMENTS:
            raise WorldError(
                f"too large (more than {MOST_ELEMENTS:,} nodes and ways); cut it smaller"
            )

    def _node(self, node: osmium.osm.Node, tags: Tags) -> None:
        location = node.location
        if location.valid():
            place = self._near(location.lon), location.lat
            self._places[node.id] = place
            if tags:
                self._nodes.append((node.id, place, tags))

    def _near(self, longitude_deg: float) -> float:
        """Return a longitude on the same side of the antimeridian as the first node."""
        if self._first_deg is None:
            self._first_deg = longitude_deg
        return longitude_deg + 360.0 * round((self._first_deg - longitude_deg) / 360.0)

    def _relation(self, relation: osmium.osm.Relation, tags: Tags) -> None:
        if tags.get("type") == "multipolygon":
            roles = {member.ref: member.role for member in relation.members if member.type == "w"}
            self._relations.append((relation.id, roles, tags))
            self._points += len(relation.members)

    def _way(self, number: int, refs: NDArray[np.int64], tags: Tags) -> None:
        places = [self._places[ref] for ref in refs.tolist() if ref in self._places]
        if refs.size > MOST_POINTS_OF_A_WAY:
            reason = f"it has more than {MOST_POINTS_OF_A_WAY} points"
        elif len(places) < refs.size:
            # A way without a corner would have another shape.
            reason = "a point is missing"
        elif refs.size < 2:
            reason = "it has fewer than two points"
        else:
            self._ways[number] = np.array(places), tags
            return
        self._broken_ways.add(number)
        if tags:
            self._broken.append(Unread(tags, reason))

    def square(self, around: MapSurroundings) -> NDArray[np.float64]:
        """Return [[lon_min, lat_min], [lon_max, lat_max]] about a position."""
        middle = np.array([self._near(around.longitude_deg), around.latitude_deg])
        reach = around.radius_m / metres_per_degree(around.latitude_deg)
        return np.array([middle - reach, middle + reach])

    def bounds(self, box: osmium.osm.Box) -> NDArray[np.float64]:
        """Return [[lon_min, lat_min], [lon_max, lat_max]], from the header if present."""
        if box.valid():
            corners = [
                (self._near(corner.lon), corner.lat) for corner in (box.bottom_left, box.top_right)
            ]
            return np.sort(np.array(corners), axis=0)
        drawn = {ref for _, roles, _ in self._relations for ref in roles}
        places = [np.array([xy]) for _, xy, _ in self._nodes] + [
            points for number, (points, tags) in self._ways.items() if tags or number in drawn
        ]
        if not places:
            raise WorldError("the file contains no located nodes or ways")
        every = np.concatenate(places)
        low = every.min(axis=0)
        high = every.max(axis=0)
        # The robot cannot leave the bounds, so a road along them needs a margin.
        margin = _BEYOND_M / metres_per_degree(float((low + high)[1]) / 2)
        return np.array([low - margin, high + margin])

    def extract(self, degrees: NDArray[np.float64]) -> Extract:
        """Convert the elements to metres about the bounds' middle; assemble the relations."""
        origin = degrees.mean(axis=0)
        scale = metres_per_degree(float(origin[1]))
        x_min, y_min, x_max, y_max = ((degrees - origin) * scale).ravel().tolist()
        lines = {number: (points - origin) * scale for number, (points, _) in self._ways.items()}
        relations, drawn = self._put_together(lines)
        return Extract(
            bounds=(x_min, y_min, x_max, y_max),
            latitude_deg=float(origin[1]),
            longitude_deg=math.remainder(float(origin[0]), 360.0),
            nodes=[
                Element(number, (np.array(xy) - origin) * scale, tags)
                for number, xy, tags in self._nodes
            ],
            ways=[
                Element(n, lines[n], tags)
                for n, (_, tags) in self._ways.items()
                if tags and n not in drawn
            ],
            relations=relations,
            broken=self._broken,
            repeated=[
                Unread(self._ways[number][1], "drawn with its relation") for number in sorted(drawn)
            ],
        )

    def _put_together(
        self, lines: Mapping[int, NDArray[np.float64]]
    ) -> tuple[list[Element[BaseGeometry]], set[int]]:
        """Assemble the relations; return them with the ids of the ways that repeat them."""
        relations: list[Element[BaseGeometry]] = []
        drawn: set[int] = set()
        points = 0
        for number, roles, tags in self._relations:
            points += sum(len(lines[ref]) for ref in roles if ref in lines)
            try:
                if points > MOST_POINTS:
                    raise OutlineError(
                        f"too large (the file's relations exceed {MOST_POINTS:,} points)"
                    )
                relations.append(Element(number, self._area(lines, roles), tags))
            except OutlineError as error:
                self._broken.append(Unread(tags, str(error)))
            else:
                outer = {ref for ref, role in roles.items() if role != "inner"}
                drawn |= {ref for ref in outer if _draws_again(self._ways[ref][1], tags)}
        return relations, drawn

    def _area(
        self, lines: Mapping[int, NDArray[np.float64]], roles: Mapping[int, str]
    ) -> BaseGeometry:
        if not self._broken_ways.isdisjoint(roles):
            raise OutlineError("a member is invalid")
        if not lines.keys() >= roles.keys():
            raise OutlineError("a member is not in the file")
        outer, inner = (
            [LineString(lines[ref]) for ref in roles if (roles[ref] == "inner") == hole]
            for hole in (False, True)
        )
        return _area_of_rings(outer, inner)


def _draws_again(way: Tags, relation: Tags) -> bool:
    """Return whether a tagged way repeats its relation: equal tags, or the same kind of area."""
    return bool(way) and (way == relation or bool(_KIND_KEYS & way.keys() & relation.keys()))


def _area_of_rings(outer: Sequence[LineString], inner: Sequence[LineString]) -> BaseGeometry:
    """Assemble the area of a multipolygon from its members' lines, in any order and direction.

    A ring inside another of the same role is a hole, as in relations with missing roles.

    Raises
    ------
    OutlineError
        Lines do not join to closed rings, rings cross, or the area is empty.
    """
    shells = _faces(outer)
    holes = _faces(inner)
    if not shells:
        raise OutlineError(OPEN)
    _, overlapping = STRtree(shells + holes).query(shells + holes, "overlaps")
    if len(overlapping):
        raise OutlineError(_BROKEN_RINGS)
    # Faces of nested rings are disjoint: every second face, from outside inwards, belongs to the
    # area.
    area = shapely.build_area(shapely.GeometryCollection(list(outer)))
    if holes:
        area = area.difference(shapely.union_all(holes))
    if not area.is_valid:
        raise OutlineError(_BROKEN_RINGS)
    return only_areas(area)


def _faces(lines: Sequence[LineString]) -> list[BaseGeometry]:
    """Return the faces of closed rings, each without the faces inside it."""
    if not lines:
        return []
    faces, *left_over = shapely.polygonize_full(list(lines))
    if not all(rest.is_empty for rest in left_over):
        raise OutlineError(_BROKEN_RINGS)
    return list(shapely.get_parts(faces))


def only_areas(geometry: BaseGeometry) -> BaseGeometry:
    """Return the polygons of a geometry as one geometry; raises OutlineError if there are none."""
    parts = polygons(geometry)
    if not parts:
        raise OutlineError("its outline has no area")
    return parts[0] if len(parts) == 1 else MultiPolygon(parts)


def _format(path: Path) -> str:
    """Return the format of a file for osmium, by its content; reject other and large files."""
    size = path.stat().st_size
    if size > LARGEST_MAP:
        raise WorldError(
            f"too large ({size / 1e6:.0f} MB > maximum {LARGEST_MAP / 1e6:.0f} MB); cut it smaller"
        )
    with path.open("rb") as file:
        start = file.read(64)
    if other := next((what for mark, what in _OTHERS.items() if start.startswith(mark)), None):
        raise WorldError(f"not an OpenStreetMap file but {other}")
    found = next((form for mark, form in _FORMATS.items() if start.startswith(mark)), "osm")
    return "pbf" if _PBF in start else found


def _deleted(path: Path, form: str) -> set[tuple[str, int]]:
    """Return the elements that JOSM marks as deleted, by the letter of their type and number."""
    found: set[tuple[str, int]] = set()
    if form in _XML:
        with _XML[form](path) as file:
            for line in file:
                found |= {(kind[:1].decode(), int(n)) for kind, n in _DELETED.findall(line)}
    return found


def _check_size(extract: Extract) -> None:
    x_min, y_min, x_max, y_max = extract.bounds
    if min(x_max - x_min, y_max - y_min) < _SMALLEST_M:
        raise WorldError("the map's bounds are empty")
    extent_m = max(x_max - x_min, y_max - y_min)
    if extent_m > LARGEST_M:
        span = f"{extent_m / 1000:.0f} km > maximum {LARGEST_M / 1000:.0f} km"
        raise WorldError(f"too large ({span}); import a part with --around")
    lines = [LineString(way.shape) for way in extract.ways if not _LINEAR_KEYS.isdisjoint(way.tags)]
    length_m = sum(shapely.clip_by_rect(line, *extract.bounds).length for line in lines)
    if length_m > MOST_WAY_M:
        excess = f"{length_m / 1000:.0f} km > maximum {MOST_WAY_M / 1000:.0f} km"
        raise WorldError(f"roads, barriers and waterways too long ({excess})")
    tags = [
        element.tags
        for elements in (extract.nodes, extract.ways, extract.relations)
        for element in elements
    ]
    if any(len(value) > LONGEST_TAG for some in tags for value in some.values()):
        raise WorldError(f"a tag is too large (maximum {LONGEST_TAG} characters)")


def metres_per_degree(latitude_deg: float) -> NDArray[np.float64]:
    """Return metres per degree of longitude and latitude (ellipsoid; 0.1 % over kilometres)."""
    latitude = math.radians(latitude_deg)
    flat = 1.0 - _ECCENTRICITY_SQUARED * math.sin(latitude) ** 2
    prime_vertical = _SEMI_MAJOR_M / math.sqrt(flat)
    meridian = _SEMI_MAJOR_M * (1.0 - _ECCENTRICITY_SQUARED) / flat**1.5
    return math.radians(1.0) * np.array(
        [prime_vertical * math.cos(latitude), meridian], dtype=np.float64
    )
