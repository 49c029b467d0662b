"""From tagged ways and nodes to the things of a terrain."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from shapely import LineString, Polygon, box, make_valid

from services.simulator.world import looks
from services.simulator.world.terrain import (
    Area,
    AreaKind,
    Barrier,
    BarrierKind,
    Building,
    Road,
    Terrain,
    Tree,
    TreeKind,
)

if TYPE_CHECKING:
    from shapely.geometry.base import BaseGeometry

    from services.simulator.world.osm import OsmExtract, OsmNode, OsmWay

    Thing = Building | Road | Area | Barrier

_STREET_WIDTH_M: Final = {
    "motorway": 12.0, "trunk": 11.0, "primary": 10.0, "secondary": 9.0, "tertiary": 8.0,
    "residential": 7.0, "unclassified": 6.5, "living_street": 5.0, "service": 4.5, "track": 3.0,
}  # fmt: skip
_PATH_WIDTH_M: Final = {"pedestrian": 4.0, "footway": 2.4, "cycleway": 2.6, "path": 2.0, "bridleway": 2.0}
_NOT_FOR_A_ROBOT: Final = frozenset({"motorway", "trunk"})
_MARKED: Final = frozenset({"primary", "secondary", "tertiary", "residential"})
_AREA_KIND: Final[dict[tuple[str, str], AreaKind]] = {
    ("landuse", "grass"): "grass", ("leisure", "park"): "grass", ("leisure", "garden"): "grass",
    ("leisure", "pitch"): "grass", ("natural", "grassland"): "grass", ("landuse", "meadow"): "grass",
    ("landuse", "recreation_ground"): "grass", ("natural", "water"): "water", ("amenity", "parking"): "paved",
    ("place", "square"): "paved",
}  # fmt: skip
_BARRIERS: Final[dict[str, tuple[BarrierKind, float]]] = {
    "hedge": ("hedge", 1.6), "wall": ("wall", 2.0), "retaining_wall": ("wall", 1.2), "fence": ("fence", 1.3),
}  # fmt: skip
_TREE_HEIGHT_M: Final[dict[TreeKind, float]] = {"round": 7.0, "tall": 11.0, "conifer": 10.0}
_SMALLEST_BUILDING_M2: Final = 4.0


def terrain_from(extract: OsmExtract, name: str) -> Terrain:
    """Build the things of a terrain from an extract, leaving out and counting what is broken."""
    frame = box(*extract.bounds)
    found = [_things_of(way, frame) for way in extract.ways]
    things = [thing for some in found for thing in some or ()]
    trees = [_tree(node) for node in extract.nodes if node.tags.get("natural") == "tree" and _is_in(node, frame)]
    return Terrain(
        name=name,
        bounds=extract.bounds,
        buildings=tuple(thing for thing in things if isinstance(thing, Building)),
        roads=tuple(thing for thing in things if isinstance(thing, Road)),
        areas=tuple(thing for thing in things if isinstance(thing, Area)),
        trees=tuple(trees),
        barriers=tuple(thing for thing in things if isinstance(thing, Barrier)),
        skipped=extract.skipped + found.count(None),
    )


def _things_of(way: OsmWay, frame: Polygon) -> list[Thing] | None:
    """Return what a way stands for inside the frame: nothing, one thing or pieces; None for a broken way."""
    tags = way.tags
    if _is_hidden(tags):
        return []
    if tags.get("building", "no") != "no":
        return _buildings(way, frame)
    if "highway" in tags and tags.get("area") != "yes":
        return _roads(way, frame)
    if tags.get("barrier") in _BARRIERS:
        kind, height = _BARRIERS[tags["barrier"]]
        height = looks.metres(tags.get("height")) or height
        return [Barrier(line, height, kind) for line in _lines(LineString(way.points).intersection(frame))]
    area = next((kind for (key, value), kind in _AREA_KIND.items() if tags.get(key) == value), None)
    if area is None:
        return []
    rings = _polygons(way, frame)
    return None if rings is None else [Area(ring, area) for ring in rings]


def _is_hidden(tags: looks.Tags) -> bool:
    """Return whether the way lies under the ground or inside a building, where nobody would see or reach it."""
    below = tags.get("layer", "0").startswith("-") or tags.get("location") == "underground"
    return below or tags.get("tunnel", "no") != "no" or tags.get("indoor", "no") != "no"


def _buildings(way: OsmWay, frame: Polygon) -> list[Thing] | None:
    rings = _polygons(way, frame)
    if rings is None:
        return None
    look, height, roof = looks.facade(way.tags, way.id), looks.height_m(way.tags), looks.roof_shape(way.tags)
    return [Building(ring, height, look, roof) for ring in rings if ring.area >= _SMALLEST_BUILDING_M2]


def _roads(way: OsmWay, frame: Polygon) -> list[Thing] | None:
    highway = way.tags["highway"]
    usual_width = _STREET_WIDTH_M.get(highway) or _PATH_WIDTH_M.get(highway)
    if usual_width is None:  # steps, proposed, construction, ...: nothing to drive on or to draw
        return []
    line = LineString(way.points)
    if line.length == 0:
        return None
    width = min(max(looks.metres(way.tags.get("width")) or usual_width, 1.0), 40.0)
    street, marked = highway in _STREET_WIDTH_M, highway in _MARKED
    return [
        Road(part, width, "street" if street else "path", highway not in _NOT_FOR_A_ROBOT, marked, marked)
        for part in _lines(line.intersection(frame))
    ]


def _tree(node: OsmNode) -> Tree:
    conifer = node.tags.get("leaf_type") == "needleleaved"
    broad: tuple[TreeKind, TreeKind] = ("round", "tall")
    kind: TreeKind = "conifer" if conifer else broad[node.id % 2]
    height = looks.metres(node.tags.get("height")) or _TREE_HEIGHT_M[kind] * (0.85 + 0.06 * (node.id % 6))
    return Tree(float(node.xy[0]), float(node.xy[1]), min(height, 40.0), kind)


def _is_in(node: OsmNode, frame: Polygon) -> bool:
    x_min, y_min, x_max, y_max = frame.bounds
    return bool(x_min <= node.xy[0] <= x_max and y_min <= node.xy[1] <= y_max)


def _polygons(way: OsmWay, frame: Polygon) -> list[Polygon] | None:
    """Return the way's area inside the frame, untangled where its outline crosses itself; None if it has none."""
    if not way.closed or len(way.points) < 4:
        return None
    area = make_valid(Polygon(way.points)).intersection(frame)
    parts = [part for part in getattr(area, "geoms", [area]) if isinstance(part, Polygon) and part.area > 0]
    return parts or (None if frame.intersects(LineString(way.points)) else [])


def _lines(geometry: BaseGeometry) -> list[LineString]:
    parts = getattr(geometry, "geoms", [geometry])
    return [part for part in parts if isinstance(part, LineString) and part.length > 0]
