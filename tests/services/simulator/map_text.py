"""OpenStreetMap files for tests, drawn in metres about a place where a degree has known lengths."""

from collections.abc import Sequence
from pathlib import Path
from xml.sax.saxutils import quoteattr

from services.simulator.world.osm import metres_per_degree

LATITUDE = 50.0
LONGITUDE = 8.0
EAST_M, NORTH_M = (float(value) for value in metres_per_degree(LATITUDE))

Point = tuple[float, float]


class MapText:
    """An OpenStreetMap file in the making; equal points are the same node."""

    def __init__(self, half_m: float = 100.0) -> None:
        self._half_m = half_m
        self._node_of: dict[Point, int] = {}
        self._nodes: list[str] = []
        self._ways: list[str] = []
        self._relations: list[str] = []
        self._next = 1

    def node(self, at: Point, /, **tags: str) -> int:
        number = self._node_of.get(at)
        if number is None or tags:
            number = self._new()
            self._node_of.setdefault(at, number)
            latitude = LATITUDE + at[1] / NORTH_M
            longitude = LONGITUDE + at[0] / EAST_M
            self._nodes.append(
                f'<node id="{number}" version="1" lat="{latitude:.7f}" lon="{longitude:.7f}">{_tags(tags)}</node>'
            )
        return number

    def way(self, points: Sequence[Point], /, **tags: str) -> int:
        refs = "".join(f'<nd ref="{self.node(point)}"/>' for point in points)
        number = self._new()
        self._ways.append(f'<way id="{number}" version="1">{refs}{_tags(tags)}</way>')
        return number

    def box(self, x: float, y: float, east_m: float, north_m: float, /, **tags: str) -> int:
        return self.way(corners(x, y, east_m, north_m), **tags)

    def relation(self, members: Sequence[tuple[str, int, str]], **tags: str) -> int:
        number = self._new()
        parts = "".join(
            f'<member type="{kind}" ref="{ref}" role="{role}"/>' for kind, ref, role in members
        )
        self._relations.append(
            f'<relation id="{number}" version="1">{parts}{_tags(tags)}</relation>'
        )
        return number

    def multipolygon(self, outer: Sequence[int], inner: Sequence[int] = (), **tags: str) -> int:
        members = [("way", ref, "outer") for ref in outer] + [
            ("way", ref, "inner") for ref in inner
        ]
        return self.relation(members, type="multipolygon", **tags)

    def text(self) -> str:
        north = self._half_m / NORTH_M
        east = self._half_m / EAST_M
        bounds = (
            f'<bounds minlat="{LATITUDE - north:.7f}" minlon="{LONGITUDE - east:.7f}" '
            f'maxlat="{LATITUDE + north:.7f}" maxlon="{LONGITUDE + east:.7f}"/>'
        )
        return "\n".join(
            ['<osm version="0.6">', bounds, *self._nodes, *self._ways, *self._relations, "</osm>"]
        )

    def write(self, path: Path) -> Path:
        path.write_text(self.text())
        return path

    def _new(self) -> int:
        self._next += 1
        return self._next


def corners(x: float, y: float, width: float, height: float) -> list[Point]:
    """Return a closed rectangle about a middle."""
    left = x - width / 2
    right = x + width / 2
    low = y - height / 2
    high = y + height / 2
    return [(left, low), (right, low), (right, high), (left, high), (left, low)]


def block_of_houses() -> MapText:
    """Return a map in which a task can be found: a ring of road about a block, and houses."""
    made = MapText()
    made.way([(-60, -60), (60, -60), (60, 60), (-60, 60), (-60, -60)], highway="residential")
    for x in (-30, 0, 30):
        made.box(x, 40, 16, 12, building="house")
        made.box(x, -40, 16, 12, building="yes")
    return made


def _tags(tags: dict[str, str]) -> str:
    named = ((key.replace("__", ":"), value) for key, value in tags.items())
    return "".join(f"<tag k={quoteattr(key)} v={quoteattr(value)}/>" for key, value in named)
