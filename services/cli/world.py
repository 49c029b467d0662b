"""``smal world``: worlds out of maps."""

from __future__ import annotations

import math
import re
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from services.cli import outputs
from services.cli.grouping import STYLE
from services.cli.world_render import render
from services.kit.errors import JobError, UsageError
from services.kit.tables import table
from services.simulator.world import Pose, World, WorldError
from services.simulator.world.importing import import_map
from services.simulator.world.loading import Wishes
from services.simulator.world.osm import Surroundings
from services.simulator.world.route import lane_graph, plan_route, route_length_m
from services.simulator.world.terrain import Terrain

if TYPE_CHECKING:
    from collections.abc import Iterable

app = typer.Typer(
    help="Make worlds out of maps.\n\nExample: smal world import map.osm --out town.json",
    **STYLE,
)

_NUMBER = r"[-+]?\d+(?:\.\d+)?"


app.command("render")(render)


@app.command("import")
def import_world(
    osm_map: Annotated[Path, typer.Argument(metavar="MAP.osm", help="OpenStreetMap XML, as exported by its site.")],
    out: Annotated[Path, typer.Option(help="Where to write the world; its name ends in .json.")],
    start: Annotated[
        str | None,
        typer.Option(metavar="X,Y,HEADING_DEG", help="Where the robot starts. [default: by rule]"),
    ] = None,
    victim: Annotated[
        str | None, typer.Option(metavar="X,Y[,HEADING_DEG]", help="Where the victim lies. [default: by rule]")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Another seed gives another task by rule.")] = 0,
    around: Annotated[
        str | None, typer.Option(metavar="LAT,LON", help="Middle of the part of the map to take.")
    ] = None,
    radius: Annotated[
        float | None,
        typer.Option(min=50, max=5000, metavar="M", help="Take so much of it on each side, of the task by default."),
    ] = None,
) -> None:
    """Turn an OpenStreetMap extract into a world to drive in.

    Buildings (with courtyards, parts, roofs), roads with sidewalks and markings, water, woods, trees and barriers
    become a terrain; what is broken is left out and counted. Start and victim are what the map's smal:role nodes say,
    else chosen by rule: the victim beside a wall near the middle, the start about 100 m of road away, where nothing
    of the victim is seen. X and Y are metres east and north of the map's middle, headings degrees from east,
    anticlockwise. The file is JSON; to move the victim by hand, change its x and y there.

    Example: smal world import map.osm --out town.json --seed 3
    """
    began_s = time.perf_counter()
    if out.suffix != ".json":
        raise UsageError(f"--out {out}: the name of a world file ends in .json")
    outputs.check_file(out, "--out")
    wishes = Wishes(
        start=None if start is None else _pose(start, "--start", (3,)),
        victim=None if victim is None else _pose(victim, "--victim", (2, 3)),
        seed=seed,
        around=_surroundings(around, radius),
    )
    if not osm_map.is_file():
        raise UsageError(f"{osm_map}: no such file")
    try:
        imported, text = import_map(osm_map, out, wishes, radius if around is None else None)
    except WorldError as error:
        raise JobError(str(error)) from None
    with outputs.writing(out, "--out") as file:
        file.write(text.encode())
    for line in table(list(_summary(imported, time.perf_counter() - began_s)), left=1):
        typer.echo(line)
    typer.echo(f"wrote {out}; next: smal demonstrate --world {out} --out DIR")


def _pose(text: str, option: str, sizes: Iterable[int]) -> Pose:
    numbers = [float(part) for part in text.split(",")] if re.fullmatch(rf"{_NUMBER}(,{_NUMBER})*", text) else []
    if len(numbers) not in sizes:
        wanted = "X,Y,HEADING_DEG" if option == "--start" else "X,Y or X,Y,HEADING_DEG"
        raise UsageError(f"{option} {text!r}: expected {wanted}, for example 12.5,-3,90")
    x, y, heading_deg = (*numbers, 0.0)[:3]
    if not all(map(math.isfinite, (x, y, heading_deg))):
        raise UsageError(f"{option} {text!r}: larger than any world")
    return Pose(x, y, math.remainder(math.radians(heading_deg), math.tau))


def _surroundings(around: str | None, radius: float | None) -> Surroundings | None:
    if around is None:
        return None
    if radius is None:
        raise UsageError(f"--around {around}: needs --radius, in metres")
    if not re.fullmatch(rf"{_NUMBER},{_NUMBER}", around):
        raise UsageError(f"--around {around!r}: expected LAT,LON in degrees, for example 39.751,-105.223")
    latitude, longitude = map(float, around.split(","))
    if not (abs(latitude) <= 85 and abs(longitude) <= 180):
        raise UsageError(f"--around {around!r}: latitude is from -85 to 85 degrees, longitude from -180 to 180")
    return Surroundings(latitude, longitude, radius)


def _summary(world: World, took_s: float) -> Iterable[tuple[str, str]]:
    terrain = world.place
    if not isinstance(terrain, Terrain) or terrain.source is None:
        raise TypeError("only a map's terrain has a summary")
    source = terrain.source
    x_min, y_min, x_max, y_max = terrain.bounds
    kilometres = sum(road.line.length for road in terrain.roads) / 1000
    drivable = sum(lane.length for lane in terrain.lanes) / 1000
    route = plan_route(world, (world.start.x, world.start.y))
    yield "size", f"{x_max - x_min:.0f} x {y_max - y_min:.0f} m"
    yield "buildings", f"{len(terrain.buildings)}"
    yield "  from relations", f"{source.used.get('building relation', 0)}"
    yield "  drawn as their parts", f"{source.used.get('building part', 0)}"
    yield "roads", f"{kilometres:.2f} km"
    yield "  drivable and connected", f"{drivable:.2f} km"
    yield "  points of the graph", f"{len(lane_graph(terrain).points)}"
    yield "trees", f"{len(terrain.trees)}"
    yield "areas", f"{len(terrain.areas)}"
    yield "barriers", f"{len(terrain.barriers)}"
    yield "skipped", f"{terrain.skipped}"
    for reason, count in source.skipped.items():
        yield f"  {reason}", f"{count}"
    yield "left out", f"{sum(source.left_out.values())}"
    for reason, count in source.left_out.items():
        yield f"  {reason}", f"{count}"
    yield "route", f"{route_length_m(route):.1f} m"
    yield "time", f"{took_s:.1f} s"
