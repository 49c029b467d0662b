"""Read an OpenStreetMap XML file into ways and nodes in local metres."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import osmium

from schemas.codec import printable
from services.simulator.world.place import WorldError

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

# WGS84: semi-major axis in metres and first eccentricity squared.
_SEMI_MAJOR_M = 6_378_137.0
_ECCENTRICITY_SQUARED = 6.694_379_990_14e-3
# A larger world would take more memory than a machine has: roads become points a couple of metres apart.
_LARGEST_M = 10_000.0
_MOST_WAY_M = 500_000.0
# OpenStreetMap's own limit; only a file made by hand has longer ones.
_LONGEST_TAG = 255


@dataclass(frozen=True)
class OsmNode:
    """A tagged point; `xy` is (2,) in metres."""

    id: int
    xy: NDArray[np.float64]
    tags: Mapping[str, str]


@dataclass(frozen=True)
class OsmWay:
    """A tagged line; `points` is (n, 2) in metres, n at least 2."""

    id: int
    points: NDArray[np.float64]
    closed: bool
    tags: Mapping[str, str]


@dataclass(frozen=True)
class OsmExtract:
    """The tagged content of a file, centred on the middle of its bounds."""

    bounds: tuple[float, float, float, float]
    nodes: tuple[OsmNode, ...]
    ways: tuple[OsmWay, ...]
    skipped: int


class _Collector:
    """Gather tagged elements in degrees while the file streams by."""

    def __init__(self) -> None:
        self.nodes: list[tuple[int, tuple[float, float], dict[str, str]]] = []
        self.ways: list[tuple[int, list[tuple[float, float]], bool, dict[str, str]]] = []
        self.skipped = 0

    def node(self, node: osmium.osm.Node) -> None:
        if len(node.tags) and node.location.valid():
            self.nodes.append((node.id, (node.location.lon, node.location.lat), dict(node.tags)))

    def way(self, way: osmium.osm.Way) -> None:
        if not len(way.tags):
            return
        places = [(ref.location.lon, ref.location.lat) for ref in way.nodes if ref.location.valid()]
        # A way that lost a corner would be drawn as another shape, so it is left out and counted.
        if len(places) < max(2, len(way.nodes)):
            self.skipped += 1
            return
        self.ways.append((way.id, places, way.is_closed(), dict(way.tags)))


def read_osm(path: Path) -> OsmExtract:
    """Read an OpenStreetMap XML file.

    Parameters
    ----------
    path
        A file as exported by openstreetmap.org. Its `<bounds>` set the origin; without them, the nodes' extent does.

    Raises
    ------
    WorldError
        The file cannot be read, is not OpenStreetMap XML, is cut short, holds no located element, or is too large.
    """
    collector = _Collector()
    try:
        processor = osmium.FileProcessor(osmium.io.File(str(path), "osm")).with_locations()
        for element in processor:
            if isinstance(element, osmium.osm.Node):
                collector.node(element)
            elif isinstance(element, osmium.osm.Way):
                collector.way(element)
        box = processor.header.box()
    except (RuntimeError, OSError, ValueError, osmium.InvalidLocationError) as error:
        raise WorldError(f"{path}: not a readable OpenStreetMap XML file ({printable(str(error))})") from error
    degrees = _degree_bounds(collector, box)
    if degrees is None:
        raise WorldError(f"{path}: the file holds no located nodes or ways")
    extract = _to_metres(collector, degrees)
    _check_size(extract, path)
    return extract


def _check_size(extract: OsmExtract, path: Path) -> None:
    x_min, y_min, x_max, y_max = extract.bounds
    extent_m = max(x_max - x_min, y_max - y_min)
    if extent_m > _LARGEST_M:
        raise WorldError(f"{path}: spans {extent_m / 1000:.0f} km; a world spans at most {_LARGEST_M / 1000:.0f} km")
    length_m = sum(float(np.linalg.norm(np.diff(way.points, axis=0), axis=1).sum()) for way in extract.ways)
    if length_m > _MOST_WAY_M:
        raise WorldError(f"{path}: {length_m / 1000:.0f} km of ways; a world has at most {_MOST_WAY_M / 1000:.0f} km")
    tags = [thing.tags for thing in extract.nodes] + [thing.tags for thing in extract.ways]
    if any(len(value) > _LONGEST_TAG for some in tags for value in some.values()):
        raise WorldError(f"{path}: a tag is longer than the {_LONGEST_TAG} characters that OpenStreetMap allows")


def _degree_bounds(collector: _Collector, box: osmium.osm.Box) -> NDArray[np.float64] | None:
    """Return [[lon_min, lat_min], [lon_max, lat_max]], from the header where it has them."""
    if box.valid():
        corners = box.bottom_left, box.top_right
        return np.array([[corner.lon, corner.lat] for corner in corners])
    places = [place for _, place, _ in collector.nodes]
    places += [place for _, way, _, _ in collector.ways for place in way]
    if not places:
        return None
    return np.array([np.min(places, axis=0), np.max(places, axis=0)])


def _to_metres(collector: _Collector, degrees: NDArray[np.float64]) -> OsmExtract:
    origin = degrees.mean(axis=0)
    scale = _metres_per_degree(float(origin[1]))
    low, high = (degrees - origin) * scale
    return OsmExtract(
        bounds=(float(low[0]), float(low[1]), float(high[0]), float(high[1])),
        nodes=tuple(OsmNode(i, (np.array(place) - origin) * scale, tags) for i, place, tags in collector.nodes),
        ways=tuple(OsmWay(i, (np.array(way) - origin) * scale, ring, tags) for i, way, ring, tags in collector.ways),
        skipped=collector.skipped,
    )


def _metres_per_degree(latitude_deg: float) -> NDArray[np.float64]:
    """Return metres per degree of longitude and of latitude on the ellipsoid; exact to 0.1 % over a few kilometres."""
    latitude = math.radians(latitude_deg)
    flat = 1.0 - _ECCENTRICITY_SQUARED * math.sin(latitude) ** 2
    prime_vertical = _SEMI_MAJOR_M / math.sqrt(flat)
    meridian = _SEMI_MAJOR_M * (1.0 - _ECCENTRICITY_SQUARED) / flat**1.5
    return math.radians(1.0) * np.array([prime_vertical * math.cos(latitude), meridian], dtype=np.float64)
