"""Terrains as world files, and back: see `terrain_format` for what is in one."""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import asdict
from typing import TYPE_CHECKING, Final

import numpy as np
import shapely
from pydantic import ValidationError
from shapely import LineString, Polygon

from schemas.codec import describe
from services.kit.going_on import each
from services.simulator.world.osm_limits import LARGEST_M, MOST_WAY_M
from services.simulator.world.place import Pose, World, WorldError
from services.simulator.world.terrain import Area, Barrier, Building, Facade, Road, Source, Terrain, Tree
from services.simulator.world.terrain_format import (
    FORMAT,
    AreaRecord,
    BarrierRecord,
    BuildingRecord,
    PoseRecord,
    RoadRecord,
    SourceRecord,
    TerrainRecord,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from services.simulator.world.place import Rgb

    Json = dict[str, object]

_DECIMALS: Final = 3
_GRID_M: Final = 10.0**-_DECIMALS


def terrain_text(world: World) -> str:
    """Return the content of the file of a world whose place is a terrain, a thing a line.

    Reading it gives the world again, with lengths rounded to the millimetre and headings to a thousandth of a degree.
    """
    lines = []
    for key, value in _content(world).items():
        if isinstance(value, list) and value and isinstance(value[0], dict):
            items = ",\n  ".join(_compact(item) for item in value)
            lines.append(f"{_compact(key)}: [\n  {items}\n ]")
        else:
            lines.append(f"{_compact(key)}: {_compact(value)}")
    return "{\n " + ",\n ".join(lines) + "\n}\n"


def read_terrain(content: Mapping[str, object], path: Path) -> World:
    """Return the world that a file's content describes.

    Parameters
    ----------
    content
        The JSON object of the file.
    path
        Of the file; it names the world, and stands in messages.

    Raises
    ------
    WorldError
        A field is missing, unknown, of another type or out of bounds; a shape crosses itself; the world is too large.
    """
    try:
        record = TerrainRecord.model_validate(content)
    except ValidationError as error:
        raise WorldError(f"{path}: {describe(error)}") from None
    try:
        terrain = _terrain(record, path.stem)
        _check_size(terrain)
    except _ShapeError as error:
        raise WorldError(f"{path}: {error}") from None
    return World(terrain, _pose(record.start), _pose(record.victim))


class _ShapeError(ValueError):
    """Points do not make the shape that they should; the message names the field."""


def _terrain(record: TerrainRecord, name: str) -> Terrain:
    x_min, y_min, x_max, y_max = record.bounds
    if not (x_min < x_max and y_min < y_max):
        raise _ShapeError("bounds: expected x_min, y_min, x_max, y_max in this order")
    return Terrain(
        name=name,
        bounds=(x_min, y_min, x_max, y_max),
        buildings=tuple(_building(item, f"buildings.{at}") for at, item in enumerate(each(record.buildings))),
        roads=tuple(_road(item, f"roads.{at}") for at, item in enumerate(record.roads)),
        areas=tuple(Area(_polygon(item, f"areas.{at}"), item.kind) for at, item in enumerate(record.areas)),
        trees=tuple(Tree(**tree.model_dump()) for tree in record.trees),
        barriers=tuple(
            Barrier(_line(item, f"barriers.{at}"), item.height_m, item.kind) for at, item in enumerate(record.barriers)
        ),
        skipped=0 if record.source is None else sum(record.source.skipped.values()),
        source=None if record.source is None else Source(**record.source.model_dump()),
    )


def _check_size(terrain: Terrain) -> None:
    x_min, y_min, x_max, y_max = terrain.bounds
    if max(x_max - x_min, y_max - y_min) > LARGEST_M:
        raise _ShapeError(f"bounds: a world spans at most {LARGEST_M / 1000:.0f} km")
    length_m = sum(road.line.length for road in terrain.roads)
    if length_m > MOST_WAY_M:
        raise _ShapeError(f"roads: {length_m / 1000:.0f} km; a world has at most {MOST_WAY_M / 1000:.0f} km")


def _building(record: BuildingRecord, field: str) -> Building:
    if record.min_height_m >= record.height_m:
        raise _ShapeError(f"{field}.min_height_m: {record.min_height_m} is not below height_m {record.height_m}")
    look = record.facade
    return Building(
        footprint=_polygon(record, field),
        height_m=record.height_m,
        facade=Facade(look.style, _rgb(look.colour), look.variant),
        roof=record.roof,
        min_height_m=record.min_height_m,
        roof_height_m=record.roof_height_m,
        roof_colour=_rgb(record.roof_colour),
    )


def _road(record: RoadRecord, field: str) -> Road:
    rest = record.model_dump(exclude={"line"})
    return Road(line=_line(record, field), **rest)


def _polygon(record: BuildingRecord | AreaRecord, field: str) -> Polygon:
    rings = [record.outline, *record.holes]
    if any(ring[0] != ring[-1] for ring in rings):
        raise _ShapeError(f"{field}: a ring does not end where it begins")
    polygon = Polygon(record.outline, record.holes)
    if not polygon.is_valid or polygon.area == 0:
        raise _ShapeError(f"{field}: its outline crosses itself or encloses nothing")
    return polygon


def _line(record: RoadRecord | BarrierRecord, field: str) -> LineString:
    line = LineString(record.line)
    if line.length == 0:
        raise _ShapeError(f"{field}.line: it has no length")
    return line


def _pose(record: PoseRecord) -> Pose:
    return Pose(record.x, record.y, math.remainder(math.radians(record.heading_deg), math.tau))


def _rgb(colour: list[int] | None) -> Rgb | None:
    return None if colour is None else (colour[0], colour[1], colour[2])


def _content(world: World) -> Json:
    terrain = world.place
    if not isinstance(terrain, Terrain):
        raise TypeError(f"a {type(terrain).__name__} is not written as {FORMAT}")
    return {
        "format": FORMAT,
        "source": None if terrain.source is None else SourceRecord(**asdict(terrain.source)).model_dump(),
        "bounds": [round(value, _DECIMALS) for value in terrain.bounds],
        "start": _pose_content(world.start),
        "victim": _pose_content(world.victim),
        "buildings": [item for building in terrain.buildings for item in _building_content(building)],
        "roads": [item for road in terrain.roads for item in _road_content(road)],
        "areas": [{**shape, "kind": area.kind} for area in terrain.areas for shape in _polygon_content(area.polygon)],
        "trees": [_rounded(asdict(tree)) for tree in terrain.trees],
        "barriers": [
            {"line": line, **_rounded({"height_m": barrier.height_m}), "kind": barrier.kind}
            for barrier in terrain.barriers
            for line in _line_content(barrier.line)
        ],
    }


def _pose_content(pose: Pose) -> Json:
    return _rounded({"x": pose.x, "y": pose.y, "heading_deg": math.degrees(pose.heading)})


def _building_content(building: Building) -> Iterator[Json]:
    numbers = {"height_m": building.height_m, "min_height_m": building.min_height_m}
    for shape in _polygon_content(building.footprint):
        yield {
            **shape,
            **_rounded(numbers),
            "roof": building.roof,
            "roof_height_m": round(building.roof_height_m, _DECIMALS),
            "roof_colour": building.roof_colour,
            "facade": asdict(building.facade),
        }


def _road_content(road: Road) -> Iterator[Json]:
    for line in _line_content(road.line):
        yield {
            "line": line,
            "width_m": round(road.width_m, _DECIMALS),
            "kind": road.kind,
            "drivable": road.drivable,
            "marked": road.marked,
            "sidewalks": road.sidewalks,
        }


def _polygon_content(polygon: Polygon) -> Iterator[Json]:
    """Yield the outline and holes of the polygons that a polygon becomes on a grid of millimetres; slivers vanish."""
    rounded = shapely.transform(polygon, _to_grid)
    if not rounded.is_valid:
        rounded = shapely.set_precision(polygon, _GRID_M)
    for part in shapely.get_parts(rounded):
        if isinstance(part, Polygon) and part.area > 0:
            yield {"outline": _points(part.exterior), "holes": [_points(ring) for ring in part.interiors]}


def _line_content(line: LineString) -> Iterator[list[list[float]]]:
    points = _points(line)
    kept = points[:1] + [point for before, point in itertools.pairwise(points) if point != before]
    if len(kept) > 1:
        yield kept


def _points(line: LineString) -> list[list[float]]:
    points: list[list[float]] = _to_grid(shapely.get_coordinates(line)).tolist()
    return points


def _to_grid(points: NDArray[np.float64]) -> NDArray[np.float64]:
    # Adding zero turns -0.0 into 0.0.
    return np.asarray(np.round(points, _DECIMALS) + 0.0, dtype=np.float64)


def _rounded(values: Mapping[str, object]) -> Json:
    return {key: round(value, _DECIMALS) if isinstance(value, float) else value for key, value in values.items()}


def _compact(value: object) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False)
