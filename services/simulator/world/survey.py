"""From tagged nodes, ways and relations to the things of a terrain."""

from __future__ import annotations

from collections import Counter
from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import LineString, Polygon
from shapely.geometry.base import BaseGeometry

from services.simulator.world import tags as meaning
from services.simulator.world.buildings import SMALLEST_M2, Outline, compose
from services.simulator.world.osm import Extract, Node, Tags
from services.simulator.world.outlines import OutlineError, area_within, line_through, lines_in, polygons_in
from services.simulator.world.planting import BROAD, USUAL_HEIGHT_M, Row, Sites, Wood, in_rows, scattered
from services.simulator.world.roads import across_squares, bridge_water, open_barriers, open_passages, road
from services.simulator.world.tags import Kind, metres
from services.simulator.world.terrain import Area, Barrier, Road, Source, Terrain, Tree, TreeKind, plan

ATTRIBUTION: Final = "© OpenStreetMap contributors, ODbL 1.0"
_LINEAR: Final = frozenset({"road", "barrier", "waterway", "row"})
_OUTSIDE: Final = "outside the map's bounds"
_TALLEST_TREE_M: Final = 40.0
_BARRIER_M: Final = (0.3, 20.0)
_WATERWAY_M: Final = (0.5, 100.0)


def terrain_from(extract: Extract, name: str, file: str) -> Terrain:
    """Build the things of a terrain from what was read of a file, leaving out and counting what is broken."""
    survey = _Survey(shapely.box(*extract.bounds))
    for way in extract.ways:
        survey.take(way.id, way.points, way.tags)
    for relation in extract.relations:
        survey.take(relation.id, relation.area, relation.tags)
    for node in extract.nodes:
        survey.node(node)
    for tags, reason in extract.broken:
        for kind in meaning.kinds_of(tags) or ("other",):
            survey.skipped[f"{kind}: {reason}"] += 1
    for tags, reason in extract.repeated:
        for kind in meaning.kinds_of(tags):
            survey.left_out[f"{kind}: {reason}"] += 1
    return survey.terrain(extract, name, file)


class _Survey:
    """Gather the things of a terrain, element by element, and count what becomes of each.

    `skipped` counts what is broken; `left_out` what is as it should be, but shows nothing here.
    """

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
        self._woods: list[Wood] = []
        self._rows: list[Row] = []
        self._trees: list[Tree] = []

    def node(self, node: Node) -> None:
        """Take a node: a tree or a gate."""
        here = shapely.Point(node.xy)
        inside = self._frame.covers(here)
        if node.tags.get("barrier") in meaning.GATES and inside:
            self._gates.append(here)
        if node.tags.get("building", "no") != "no":
            self.skipped["building: it is a point without an outline"] += 1
        if node.tags.get("natural") == "tree":
            if inside:
                self._trees.append(_tree(node))
                self._used["tree"] += 1
            else:
                self.left_out[f"tree: {_OUTSIDE}"] += 1

    def take(self, number: int, shape: NDArray[np.float64] | BaseGeometry, tags: Tags) -> None:
        """Take a way, given its points (n, 2), or a relation, given its area, for each thing that it stands for."""
        for kind in meaning.kinds_of(tags):
            if meaning.is_hidden(tags):
                self.left_out[f"{kind}: under the ground or indoors"] += 1
                continue
            if not isinstance(shape, np.ndarray):
                if kind in _LINEAR:
                    self.left_out[f"{kind}: it is an area"] += 1
                else:
                    self._used[f"{kind} relation"] += self._area(kind, number, shape, tags)
                continue
            try:
                if kind in _LINEAR:
                    self._lines(kind, number, lines_in(line_through(shape), self._frame), tags)
                else:
                    self._area(kind, number, area_within(shape), tags)
            except OutlineError as error:
                # An open line outside the bounds is not looked at: exports cut outlines there.
                if self._frame.intersects(LineString(shape)):
                    self.skipped[f"{kind}: {error}"] += 1
                else:
                    self.left_out[f"{kind}: {_OUTSIDE}"] += 1

    def terrain(self, extract: Extract, name: str, file: str) -> Terrain:
        """Return the terrain of everything that was taken."""
        composed = compose(self._outlines, self._parts)
        self._used["building part"] = composed.parts_used
        self.left_out.update({f"building part: {reason}": count for reason, count in composed.unused.items()})
        buildings = tuple(open_passages(composed.buildings, self._passages))
        barriers = tuple(open_barriers(self._barriers, self._roads, self._gates))
        roads = (*self._roads, *across_squares(self._squares, self._roads))
        areas = tuple(bridge_water(self._areas, self._roads))
        trees = self._trees
        if self._woods or self._rows:
            sites = Sites(roads, buildings, areas, barriers)
            trees = [*trees, *in_rows(self._rows, sites), *scattered(self._woods, sites)]
        used, skipped, left_out = (
            {name: counts[name] for name in sorted(counts) if counts[name]}
            for counts in (self._used, self.skipped, self.left_out)
        )
        return Terrain(
            name=name,
            source=Source(file, ATTRIBUTION, extract.latitude_deg, extract.longitude_deg, used, skipped, left_out),
            bounds=extract.bounds,
            buildings=buildings,
            roads=roads,
            areas=areas,
            trees=tuple(trees),
            barriers=barriers,
        )

    def _lines(self, kind: Kind, number: int, lines: list[LineString], tags: Tags) -> None:
        (self._used if lines else self.left_out)[kind if lines else f"{kind}: {_OUTSIDE}"] += 1
        for line in lines:
            match kind:
                case "road":
                    self._roads.append(road(line, tags))
                    if meaning.is_passage(tags):
                        self._passages.append(self._roads[-1])
                case "barrier":
                    barrier_kind, usual_m = meaning.BARRIERS[tags["barrier"]]
                    height_m = _within(_BARRIER_M, metres(tags.get("height")) or usual_m)
                    self._barriers.append(Barrier(line, height_m, barrier_kind))
                case "waterway":
                    usual_m = meaning.WATERWAY_WIDTH_M[tags["waterway"]]
                    water = line.buffer(_within(_WATERWAY_M, metres(tags.get("width")) or usual_m) / 2)
                    self._areas += [Area(**plan(part), kind="water") for part in polygons_in(water, self._frame)]
                case _:
                    self._rows.append(Row(number, line, tags.get("leaf_type", "")))

    def _area(self, kind: Kind, number: int, area: BaseGeometry, tags: Tags) -> bool:
        """Take the part of an area that is inside the frame; return whether there is one."""
        polygons = polygons_in(area, self._frame)
        if not polygons:
            self.left_out[f"{kind}: {_OUTSIDE}"] += 1
            return False
        if kind in {"building", "building part"}:
            if max(polygon.area for polygon in polygons) < SMALLEST_M2:
                self.skipped[f"{kind}: it is smaller than {SMALLEST_M2:.0f} m2"] += 1
                return False
            outlines = self._outlines if kind == "building" else self._parts
            outlines.append(Outline(number, tuple(polygons), tags))
        elif kind == "square":
            self._areas += [Area(**plan(polygon), kind="paved") for polygon in polygons]
            self._squares += polygons
        elif (cover := meaning.cover_of(tags)) is not None:
            self._areas += [Area(**plan(polygon), kind=cover.kind) for polygon in polygons]
            if cover.tree_m is not None:
                leaves = tags.get("leaf_type", "")
                self._woods += [Wood(number, polygon, cover.tree_m or None, leaves) for polygon in polygons]
        if kind != "building part":  # whether a part is used is known only when all are there
            self._used[kind] += 1
        return True


def _tree(node: Node) -> Tree:
    conifer = node.tags.get("leaf_type") == "needleleaved"
    kind: TreeKind = "conifer" if conifer else BROAD[node.id % 2]
    height = metres(node.tags.get("height")) or USUAL_HEIGHT_M[kind] * (0.85 + 0.06 * (node.id % 6))
    return Tree(float(node.xy[0]), float(node.xy[1]), min(height, _TALLEST_TREE_M), kind)


def _within(limits: tuple[float, float], value: float) -> float:
    return min(max(value, limits[0]), limits[1])
