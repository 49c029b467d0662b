"""Convert tagged nodes, ways and relations to the objects of a terrain."""

from collections import Counter
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import shapely
from shapely import LineString, MultiPolygon, Polygon, STRtree
from shapely.geometry.base import BaseGeometry

from services.simulator.world import tags as meaning
from services.simulator.world.buildings import SMALLEST_M2, Outline, compose
from services.simulator.world.osm import (
    OPEN,
    Element,
    Extract,
    OutlineError,
    Points,
    Tags,
    only_areas,
)
from services.simulator.world.place import polygons
from services.simulator.world.planting import BROAD, USUAL_HEIGHT_M, Planting, planted
from services.simulator.world.roads import (
    across_squares,
    bridge_water,
    open_barriers,
    open_passages,
    road,
)
from services.simulator.world.tags import MEANINGS, Kind, metres
from services.simulator.world.terrain import (
    Area,
    Barrier,
    Road,
    Source,
    Terrain,
    Tree,
    TreeKind,
    plan,
)

ATTRIBUTION: Final = "© OpenStreetMap contributors, ODbL 1.0"
_LINEAR: Final = frozenset({"road", "barrier", "waterway", "row"})
_OUTSIDE: Final = "outside the map's bounds"
_TALLEST_TREE_M: Final = 40.0
_BARRIER_M: Final = (0.3, 20.0)
_WATERWAY_M: Final = (0.5, 100.0)
_TANGLED: Final = "it crosses itself too often"
# The cost of untangling grows faster than the square of the crossings: 300 random corners take 13
# s.
_MOST_CROSSINGS: Final = 50
_MOST_NEAR_PAIRS_A_SEGMENT: Final = 40


def terrain_from(extract: Extract, name: str, file: str) -> Terrain:
    """Convert the content of a file to a terrain; count and skip broken elements."""
    survey = _Survey(shapely.box(*extract.bounds))
    for way in extract.ways:
        survey.take(way)
    for relation in extract.relations:
        survey.take(relation)
    for node in extract.nodes:
        survey.node(node)
    for tags, reason in extract.broken:
        survey.skipped.update(f"{kind}: {reason}" for kind in meaning.kinds_of(tags) or ("other",))
    for tags, reason in extract.repeated:
        survey.left_out.update(f"{kind}: {reason}" for kind in meaning.kinds_of(tags))
    return survey.terrain(extract, name, file)


class _Survey:
    """Collects objects of a terrain; counts used, `skipped` (broken) and `left_out` elements."""

    def __init__(self, frame: Polygon) -> None:
        self.skipped: Counter[str] = Counter()
        self.left_out: Counter[str] = Counter()
        self._used: Counter[str] = Counter()
        self._frame = frame
        self._outlines: list[Outline] = []
        self._parts: list[Outline] = []
        self._roads: list[Road] = []
        self._passages: list[Road] = []
        self._squares: list[Polygon] = []
        self._areas: list[Area] = []
        self._barriers: list[Barrier] = []
        self._gates: list[shapely.Point] = []
        self._plantings: list[Planting] = []
        self._trees: list[Tree] = []

    def node(self, node: Element[Points]) -> None:
        here = shapely.Point(node.shape)
        inside = self._frame.covers(here)
        if node.tags.get("barrier") in MEANINGS.gates and inside:
            self._gates.append(here)
        if node.tags.get("building", "no") != "no":
            self.skipped["building: it is a point without an outline"] += 1
        if node.tags.get("natural") == "tree":
            (self._used if inside else self.left_out)[
                "tree" if inside else f"tree: {_OUTSIDE}"
            ] += 1
            if inside:
                kind: TreeKind = (
                    "conifer"
                    if node.tags.get("leaf_type") == "needleleaved"
                    else BROAD[node.id % 2]
                )
                usual_m = USUAL_HEIGHT_M[kind] * (0.85 + 0.06 * (node.id % 6))
                height_m = min(metres(node.tags.get("height")) or usual_m, _TALLEST_TREE_M)
                self._trees.append(Tree(here.x, here.y, height_m, kind))

    def take(self, element: Element[Points] | Element[BaseGeometry]) -> None:
        for kind in meaning.kinds_of(element.tags):
            if meaning.is_hidden(element.tags):
                self.left_out[f"{kind}: under the ground or indoors"] += 1
            elif isinstance(element.shape, np.ndarray):
                self._way(kind, element, element.shape)
            elif kind in _LINEAR:
                self.left_out[f"{kind}: it is an area"] += 1
            else:
                self._used[f"{kind} relation"] += self._area(kind, element, element.shape)

    def _way(self, kind: Kind, way: Element[Any], points: Points) -> None:
        try:
            if kind in _LINEAR:
                # Self-crossing lines are not clipped.
                parts = shapely.get_parts(
                    shapely.clip_by_rect(_line_through(points), *self._frame.bounds)
                )
                self._lines(
                    kind,
                    way,
                    [part for part in parts if part.geom_type == "LineString" and part.length > 0],
                )
            else:
                self._area(kind, way, _area_within(points))
        except OutlineError as error:
            # Open lines outside the bounds are expected: exports cut outlines there.
            inside = self._frame.intersects(LineString(points))
            (self.skipped if inside else self.left_out)[
                f"{kind}: {error if inside else _OUTSIDE}"
            ] += 1

    def _lines(self, kind: Kind, way: Element[Any], lines: list[LineString]) -> None:
        tags = way.tags
        (self._used if lines else self.left_out)[kind if lines else f"{kind}: {_OUTSIDE}"] += 1
        for line in lines:
            match kind:
                case "road":
                    self._roads.append(road(line, tags))
                    if meaning.is_passage(tags):
                        self._passages.append(self._roads[-1])
                case "barrier":
                    barrier_kind, usual_m = MEANINGS.barriers[tags["barrier"]]
                    self._barriers.append(
                        Barrier(
                            line, _length(tags.get("height"), usual_m, _BARRIER_M), barrier_kind
                        )
                    )
                case "waterway":
                    width_m = _length(
                        tags.get("width"), MEANINGS.waterway_width_m[tags["waterway"]], _WATERWAY_M
                    )
                    water = polygons(line.buffer(width_m / 2).intersection(self._frame))
                    self._areas += [Area(**plan(part), kind="water") for part in water]
                case _:
                    self._plantings.append(Planting(way.id, line, tags.get("leaf_type", "")))

    def _area(self, kind: Kind, element: Element[Any], area: BaseGeometry) -> bool:
        """Add the part of an area inside the bounds; return whether it is not empty."""
        parts = polygons(area.intersection(self._frame))
        tags = element.tags
        if not parts:
            self.left_out[f"{kind}: {_OUTSIDE}"] += 1
            return False
        if kind in {"building", "building part"}:
            if max(part.area for part in parts) < SMALLEST_M2:
                self.skipped[f"{kind}: it is smaller than {SMALLEST_M2:.0f} m2"] += 1
                return False
            outlines = self._outlines if kind == "building" else self._parts
            outlines.append(Outline(element.id, MultiPolygon(parts), tags))
        else:
            self._ground(kind, element.id, parts, tags)
        if kind != "building part":  # The use of parts is known only at the end.
            self._used[kind] += 1
        return True

    def _ground(self, kind: Kind, number: int, parts: Sequence[Polygon], tags: Tags) -> None:
        cover = "paved" if kind == "square" else meaning.cover_of(tags) or "grass"
        self._areas += [Area(**plan(part), kind=cover) for part in parts]
        if kind == "square":
            self._squares += parts
        trees_m = meaning.trees_on(tags) if kind == "wood" else None
        if trees_m is not None:
            leaves = tags.get("leaf_type", "")
            self._plantings += [Planting(number, part, leaves, trees_m or None) for part in parts]

    def terrain(self, extract: Extract, name: str, file: str) -> Terrain:
        composed, parts = compose(self._outlines, self._parts)
        self._used["building part"] = parts.pop("used", 0)
        self.left_out.update({f"building part: {reason}": count for reason, count in parts.items()})
        buildings = tuple(open_passages(composed, self._passages))
        barriers = tuple(open_barriers(self._barriers, self._roads, self._gates))
        roads = (*self._roads, *across_squares(self._squares, self._roads))
        areas = tuple(bridge_water(self._areas, self._roads))
        trees = (*self._trees, *planted(self._plantings, roads, buildings, areas, barriers))
        counts = (
            dict(sorted((+count).items())) for count in (self._used, self.skipped, self.left_out)
        )
        return Terrain(
            name=name,
            source=Source(file, ATTRIBUTION, extract.latitude_deg, extract.longitude_deg, *counts),
            bounds=extract.bounds,
            buildings=buildings,
            roads=roads,
            areas=areas,
            trees=trees,
            barriers=barriers,
        )


def _area_within(points: Points) -> BaseGeometry:
    """Return the untangled area of a closed line (n, 2); raises OutlineError if it is invalid."""
    if len(points) < 4 or (points[0] != points[-1]).any():
        raise OutlineError(OPEN)
    area: BaseGeometry = Polygon(points)
    if not area.is_valid:
        if _is_tangled(points):
            raise OutlineError(_TANGLED)
        area = shapely.make_valid(area)
    return only_areas(area)


def _line_through(points: Points) -> LineString:
    """Return the line along points (n, 2); raises OutlineError without length or when tangled."""
    line = LineString(points)
    if line.length == 0:
        raise OutlineError("it has no length")
    if not line.is_simple and _is_tangled(points):
        raise OutlineError(_TANGLED)
    return line


def _is_tangled(points: Points) -> bool:
    segments = np.asarray(shapely.linestrings(np.stack([points[:-1], points[1:]], axis=1)))
    tree = STRtree(segments)
    if tree.query(segments).shape[1] > _MOST_NEAR_PAIRS_A_SEGMENT * len(segments):
        return True
    return bool(tree.query(segments, "crosses").shape[1] > 2 * _MOST_CROSSINGS)


def _length(text: str | None, usual_m: float, limits: tuple[float, float]) -> float:
    return min(max(metres(text) or usual_m, limits[0]), limits[1])
