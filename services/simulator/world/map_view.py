"""Draw a top view of a world for result pages."""

import math
from typing import Final

import shapely
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.patches import Circle, PathPatch
from matplotlib.path import Path
from shapely import LineString

from services.simulator.world.furniture import FurnitureKind
from services.simulator.world.place import World
from services.simulator.world.room import FittingKind, Room
from services.simulator.world.scan import ScannedPlace
from services.simulator.world.terrain import AreaKind, BarrierKind, RoadKind, Terrain

_GROUND: Final = "#e7ecdd"
_AREA: Final[dict[AreaKind, str]] = {"grass": "#cfe3b8", "water": "#b5d3e8", "paved": "#dcdad5"}
_ROAD: Final[dict[RoadKind, str]] = {"street": "#ffffff", "path": "#f3e9d8"}
_BARRIER: Final[dict[BarrierKind, str]] = {
    "hedge": "#7ba05b",
    "wall": "#8a8278",
    "fence": "#b0a493",
}
_FURNITURE: Final[dict[FurnitureKind, str]] = {
    "cabinet": "#a9adb0", "car": "#46597a", "chair": "#6f8799", "crate": "#c39a66", "desk": "#d9c6a5",
    "partition": "#6f8799", "plant": "#7ba05b", "shelf": "#9a7652", "sofa": "#9c4f43", "table": "#d9c6a5",
}  # fmt: skip
_FITTING: Final[dict[FittingKind, str]] = {
    "door": "#8a5a33", "poster": "#c2410c", "whiteboard": "#4b5563", "window": "#5aa0d6"
}  # fmt: skip
_CROWN_OF_HEIGHT: Final = 0.28


def draw_map(world: World, ax: Axes, *, marks: bool = True) -> None:
    """Draw a world in metres, with marks of start (arrow) and victim (star) if requested."""
    x_min, y_min, x_max, y_max = world.place.bounds
    ax.set(
        xlim=(x_min, x_max),
        ylim=(y_min, y_max),
        aspect="equal",
        xlabel="east (m)",
        ylabel="north (m)",
    )
    if isinstance(world.place, Room):
        _draw_room(world.place, ax)
    elif isinstance(world.place, Terrain):
        _draw_terrain(world.place, ax)
    elif isinstance(world.place, ScannedPlace):
        _draw_scan(world.place, ax)
    if marks:
        _mark_task(world, ax)


def _mark_task(world: World, ax: Axes) -> None:
    x_min, _, x_max, _ = world.place.bounds
    arrow = 0.03 * (x_max - x_min)
    start = world.start
    tip = (start.x + arrow * math.cos(start.heading), start.y + arrow * math.sin(start.heading))
    ax.annotate(
        "",
        tip,
        (start.x, start.y),
        arrowprops={"arrowstyle": "-|>", "color": "#1f5fa8", "lw": 2},
        zorder=4,
    )
    ax.plot(start.x, start.y, "o", color="#1f5fa8", markersize=6, label="start", zorder=4)
    ax.plot(
        world.victim.x,
        world.victim.y,
        "*",
        color="#d62728",
        markersize=13,
        label="victim",
        zorder=4,
    )


def _draw_terrain(terrain: Terrain, ax: Axes) -> None:
    ax.set_facecolor(_GROUND)
    for area in terrain.areas:
        _fill(ax, area.footprint, _AREA[area.kind], order=0.5)
    for road in sorted(terrain.roads, key=lambda road: road.kind):
        _fill(ax, road.line.buffer(road.width_m / 2), _ROAD[road.kind], edge="#c9c4ba", order=1.0)
    for building in terrain.buildings:
        _fill(ax, building.footprint, "#b9a894", edge="#7d6f60", order=1.5)
    for barrier in terrain.barriers:
        ax.plot(*barrier.line.xy, color=_BARRIER[barrier.kind], linewidth=1.5, zorder=1.6)
    crowns = [Circle((tree.x, tree.y), tree.height_m * _CROWN_OF_HEIGHT) for tree in terrain.trees]
    ax.add_collection(
        PatchCollection(crowns, facecolor="#7ba05b", alpha=0.7, linewidth=0, zorder=1.7)
    )


def _draw_scan(scan: ScannedPlace, ax: Axes) -> None:
    ax.set_facecolor("#c9c4ba")
    _fill(ax, scan.floor.footprint, "#f6f3ec", edge="#7d6f60", order=0.5)
    for wall in scan.walls:
        _fill(ax, wall.footprint, "#7d6f60", order=1.5)


def _draw_room(room: Room, ax: Axes) -> None:
    ax.set_facecolor("#efece4")
    for piece in room.furniture:
        _fill(ax, piece.footprint, _FURNITURE[piece.kind], edge="#5b5148", order=1.5)
    for fitting in room.fittings:
        (_, left_m, _, right_m), *_ = fitting.face()
        wall, _ = room.wall(fitting.wall)
        ends = wall.place(LineString([(0.0, left_m), (0.0, right_m)]))
        ax.plot(*ends.xy, color=_FITTING[fitting.kind], linewidth=4, zorder=1.6)
    if room.overhead is not None:
        x = room.overhead.x_m
        y = room.overhead.y_m
        ax.plot(x, y, "x", color="#444444", markersize=7, label="camera above", zorder=3)


def _fill(
    ax: Axes, polygon: shapely.Polygon, colour: str, *, order: float, edge: str = "none"
) -> None:
    rings = [
        shapely.get_coordinates(ring)
        for ring in shapely.get_rings(shapely.orient_polygons(polygon))
    ]
    # Holes have the opposite orientation, so the fill leaves them open.
    outline = Path.make_compound_path(*(Path(ring, closed=True) for ring in rings))
    ax.add_patch(PathPatch(outline, facecolor=colour, edgecolor=edge, linewidth=0.6, zorder=order))
