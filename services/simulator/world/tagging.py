"""From tagged nodes, ways and relations to the things of a terrain."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Final

import shapely
from shapely import LineString, box

from services.simulator.world import kinds, looks
from services.simulator.world.building_tags import SMALLEST_M2, Outline, compose
from services.simulator.world.kinds import Kind, Tags
from services.simulator.world.openings import bridge_water, open_barriers, open_passages
from services.simulator.world.outlines import OutlineError, area_within, line_through, lines_in, polygons_in
from services.simulator.world.planting import BROAD, USUAL_HEIGHT_M, Row, Sites, Wood, in_rows, scattered
from services.simulator.world.road_tags import across_squares, road
from services.simulator.world.terrain import Area, Barrier, Building, Road, Source, Terrain, Tree, TreeKind

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np
    from numpy.typing import NDArray
    from shapely import Polygon
    from shapely.geometry.base import BaseGeometry

    from services.simulator.world.osm import OsmExtract, OsmNode

ATTRIBUTION: Final = "© OpenStreetMap contributors, ODbL 1.0"
_LINEAR: Final = frozenset({"road", "barrier", "waterway", "row"})
_OUTSIDE: Final = "outside the map's bounds"
_TALLEST_TREE_M: Final = 40.0
_BARRIER_M: Final = (0.3, 20.0)
_WATERWAY_M: Final = (0.5, 100.0)


def terrain_from(extract: OsmExtract, name: str, file: str | None = None) -> Terrain:
    """Build the things of a terrain from an extract, leaving out and counting what is broken.

    Parameters
    ----------
    extract
        What was read.
    name
        Of the terrain.
    file
        Name of the file that the extract was read from; `name` with the usual ending if not given.
    """
    survey = _Survey(box(*extract.bounds))
    for way in extract.ways:
        survey.way(way.id, way.points, way.tags)
    for area in extract.areas:
        survey.relation(area.id, area.area, area.tags)
    for node in extract.nodes:
        survey.node(node)
    for element in extract.broken:
        survey.skip(element.tags, element.reason)
    for element in extract.repeated:
        survey.leave_out(element.tags, element.reason)
    return survey.terrain(extract, name, file or f"{name}.osm")


class _Survey:
    """Gather the things of a terrain, element by element, and count what becomes of each."""

    def __init__(self, frame: Polygon) -> None:
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
        self._used: Counter[str] = Counter()
        self._skipped: Counter[str] = Counter()
        self._left_out: Counter[str] = Counter()

    def skip(self, tags: Tags, reason: str) -> None:
        """Count an element that is broken."""
        for kind in kinds.kinds_of(tags) or ("other",):
            self._skipped[f"{kind}: {reason}"] += 1

    def leave_out(self, tags: Tags, reason: str) -> None:
        """Count an element that is as it should be, but shows nothing here."""
        for kind in kinds.kinds_of(tags):
            self._left_out[f"{kind}: {reason}"] += 1

    def node(self, node: OsmNode) -> None:
        """Take a node: a tree or a gate."""
        inside = self._frame.covers(shapely.Point(node.xy))
        if node.tags.get("barrier") in kinds.GATES and inside:
            self._gates.append(shapely.Point(node.xy))
        if node.tags.get("building", "no") != "no":
            self._skipped["building: it is a point without an outline"] += 1
        if node.tags.get("natural") == "tree":
            if inside:
                self._trees.append(_tree(node))
                self._used["tree"] += 1
            else:
                self._left_out[f"tree: {_OUTSIDE}"] += 1

    def way(self, way_id: int, points: NDArray[np.float64], tags: Tags) -> None:
        """Take a way, for each thing that it stands for."""
        for kind in kinds.kinds_of(tags):
            if kinds.is_hidden(tags):
                self._left_out[f"{kind}: under the ground or indoors"] += 1
                continue
            try:
                if kind in _LINEAR:
                    self._lines(kind, way_id, lines_in(line_through(points), self._frame), tags)
                else:
                    self._area(kind, way_id, area_within(points), tags)
            except OutlineError as error:
                # An open line outside the bounds is not looked at: exports cut outlines there.
                outside = not self._frame.intersects(LineString(points))
                (self._left_out if outside else self._skipped)[f"{kind}: {_OUTSIDE if outside else error}"] += 1

    def relation(self, relation_id: int, area: BaseGeometry, tags: Tags) -> None:
        """Take a multipolygon relation."""
        for kind in kinds.kinds_of(tags):
            if kinds.is_hidden(tags):
                self._left_out[f"{kind}: under the ground or indoors"] += 1
            elif kind in _LINEAR:
                self._left_out[f"{kind}: it is an area"] += 1
            elif self._area(kind, relation_id, area, tags):
                self._used[f"{kind} relation"] += 1

    def terrain(self, extract: OsmExtract, name: str, file: str) -> Terrain:
        """Return the terrain of everything that was taken."""
        composed = compose(self._outlines, self._parts)
        self._used["building part"] = composed.parts_used
        for reason, count in composed.unused.items():
            self._left_out[f"building part: {reason}"] += count
        buildings = tuple(open_passages(composed.buildings, self._passages))
        barriers = tuple(open_barriers(self._barriers, self._roads, self._gates))
        roads = (*self._roads, *across_squares(self._squares, self._roads))
        areas = tuple(bridge_water(self._areas, self._roads))
        return Terrain(
            name=name,
            bounds=extract.bounds,
            buildings=buildings,
            roads=roads,
            areas=areas,
            trees=(*self._trees, *self._planted(roads, buildings, areas, barriers)),
            barriers=barriers,
            skipped=self._skipped.total(),
            source=Source(
                file, ATTRIBUTION, extract.latitude_deg, extract.longitude_deg,
                _sorted(self._used), _sorted(self._skipped), _sorted(self._left_out),
            ),
        )  # fmt: skip

    def _planted(
        self,
        roads: tuple[Road, ...],
        buildings: tuple[Building, ...],
        areas: tuple[Area, ...],
        barriers: tuple[Barrier, ...],
    ) -> list[Tree]:
        if not self._woods and not self._rows:
            return []
        sites = Sites(roads, buildings, areas, barriers)
        return in_rows(self._rows, sites) + scattered(self._woods, sites)

    def _lines(self, kind: Kind, way_id: int, lines: list[LineString], tags: Tags) -> None:
        if not lines:
            self._left_out[f"{kind}: {_OUTSIDE}"] += 1
            return
        self._used[kind] += 1
        for line in lines:
            self._line(kind, way_id, line, tags)

    def _line(self, kind: Kind, way_id: int, line: LineString, tags: Tags) -> None:
        match kind:
            case "road":
                self._roads.append(road(line, tags))
                if kinds.is_passage(tags):
                    self._passages.append(self._roads[-1])
            case "barrier":
                barrier_kind, usual_m = kinds.BARRIERS[tags["barrier"]]
                height_m = looks.metres(tags.get("height")) or usual_m
                self._barriers.append(Barrier(line, min(max(height_m, _BARRIER_M[0]), _BARRIER_M[1]), barrier_kind))
            case "waterway":
                width_m = looks.metres(tags.get("width")) or kinds.WATERWAY_WIDTH_M[tags["waterway"]]
                water = line.buffer(min(max(width_m, _WATERWAY_M[0]), _WATERWAY_M[1]) / 2)
                self._areas += [Area(part, "water") for part in polygons_in(water, self._frame)]
            case _:
                self._rows.append(Row(way_id, line, tags.get("leaf_type", "")))

    def _area(self, kind: Kind, element_id: int, area: BaseGeometry, tags: Tags) -> bool:
        """Take the part of an area that is inside the frame; return whether there is one."""
        polygons = polygons_in(area, self._frame)
        if not polygons:
            self._left_out[f"{kind}: {_OUTSIDE}"] += 1
            return False
        if kind in {"building", "building part"}:
            if max(polygon.area for polygon in polygons) < SMALLEST_M2:
                self._skipped[f"{kind}: it is smaller than {SMALLEST_M2:.0f} m2"] += 1
                return False
            outlines = self._outlines if kind == "building" else self._parts
            outlines.append(Outline(element_id, tuple(polygons), tags))
        else:
            self._ground(kind, element_id, polygons, tags)
        if kind != "building part":  # whether a part is used is known only when all are there
            self._used[kind] += 1
        return True

    def _ground(self, kind: Kind, element_id: int, polygons: list[Polygon], tags: Tags) -> None:
        if kind == "square":
            self._areas += [Area(polygon, "paved") for polygon in polygons]
            self._squares += polygons
            return
        cover = kinds.cover_of(tags)
        if cover is None:
            return
        self._areas += [Area(polygon, cover.kind) for polygon in polygons]
        if cover.tree_m is not None:
            leaves = tags.get("leaf_type", "")
            self._woods += [Wood(element_id, polygon, cover.tree_m or None, leaves) for polygon in polygons]


def _tree(node: OsmNode) -> Tree:
    conifer = node.tags.get("leaf_type") == "needleleaved"
    kind: TreeKind = "conifer" if conifer else BROAD[node.id % 2]
    height = looks.metres(node.tags.get("height")) or USUAL_HEIGHT_M[kind] * (0.85 + 0.06 * (node.id % 6))
    return Tree(float(node.xy[0]), float(node.xy[1]), min(height, _TALLEST_TREE_M), kind)


def _sorted(counts: Mapping[str, int]) -> dict[str, int]:
    return {name: counts[name] for name in sorted(counts) if counts[name]}
