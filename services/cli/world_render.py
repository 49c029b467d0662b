"""``smal world render``: a world as its map, from the air and as views along the way through it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import numpy as np
import shapely
import typer
from tqdm import tqdm

from services.cli import options, outputs
from services.kit.errors import JobError
from services.simulator.scene.vulkan import RenderingUnavailableError
from services.simulator.sensors.camera import CameraSettings
from services.simulator.world import Pose, World, WorldError, load_world
from services.simulator.world.route import plan_route, route_length_m
from services.simulator.world.terrain import Terrain

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from services.simulator.scene.surfaces import Vector

# A view looks to where the route is this much later: around a corner as the robot would turn.
_AHEAD_M: Final = 1.0
# The last view stands this far before the victim, in distances from which a robot has found it.
_BEFORE_VICTIM: Final = 0.9
_MOST_VIEWS: Final = 200
# The view from the air: how long a route it shows at least and at most, and how far back and up it stands over that.
_AERIAL_M: Final = (80.0, 500.0)
_AERIAL_BACK: Final = 0.8
_AERIAL_UP: Final = 0.6


def render(
    name: Annotated[str, typer.Argument(metavar="WORLD", help="Name of a world, or the path of a map or world file.")],
    out: Annotated[Path, typer.Option(help="Folder for the pictures.")] = Path("views"),
    views: Annotated[int, typer.Option(min=2, max=_MOST_VIEWS, help="Pictures along the route.")] = 6,
    camera: options.CameraSize = None,
) -> None:
    """Draw a world: map.png from above with the planned route, and what the robot sees along that route.

    Outdoors aerial.png shows what stands around the route, from the air.

    The views are named view-NN-DISTANCEm.png by how far along the route they are; the first is at the start, the last
    one faces the victim.

    Example: smal world render campus --out campus-views --views 8
    """
    size = camera or options.USUAL_CAMERA
    outputs.make_folder(out, "--out")
    try:
        world = load_world(name)
        _draw(world, out, views, CameraSettings(size.width, size.height))
    except (WorldError, RenderingUnavailableError) as error:
        raise JobError(str(error)) from error
    typer.echo(f"wrote the map, {views} views{' and aerial.png' if isinstance(world.place, Terrain) else ''} in {out}")


def viewpoints(world: World, views: int) -> list[tuple[float, Pose]]:
    """Return where to look from along the planned route, with how far along it that is, metres.

    The first is the start, the others are evenly spread and look along the route; the last one faces the victim.
    """
    route = shapely.LineString(plan_route(world, (world.start.x, world.start.y)))
    before = min(_BEFORE_VICTIM * world.scale.found_m, route.length / 2)
    along = np.linspace(0.0, route.length - before, views)
    poses = [world.start, *(_facing(route, float(metres)) for metres in along[1:])]
    last = poses[-1]
    to_victim = math.atan2(world.victim.y - last.y, world.victim.x - last.x)
    return list(zip(map(float, along), [*poses[:-1], Pose(last.x, last.y, to_victim)], strict=True))


def _facing(route: shapely.LineString, metres: float) -> Pose:
    here, there = (shapely.get_coordinates(route.interpolate(d))[0] for d in (metres, metres + _AHEAD_M))
    east, north = there - here
    return Pose(float(here[0]), float(here[1]), math.atan2(north, east))


def _draw(world: World, out: Path, views: int, settings: CameraSettings) -> None:
    from services.simulator.scene.rendering import SceneCamera  # noqa: PLC0415 - loads the renderer

    places = viewpoints(world, views)
    world_map(world, places).savefig(out / "map.png", dpi=150)
    eye = SceneCamera(world, settings)
    for number, (metres, pose) in enumerate(tqdm(places, desc="rendering", unit="picture", dynamic_ncols=True)):
        _write(out / f"view-{number:02d}-{metres:.0f}m.png", eye.render(pose))
    if isinstance(world.place, Terrain):
        _write(out / "aerial.png", eye.look(*aerial_view(world)))


def aerial_view(world: World) -> tuple[Vector, Vector]:
    """Return where to stand in the air and what to look at, (x, y, height) metres: the route, from the south."""
    route = np.asarray(plan_route(world, (world.start.x, world.start.y)))
    middle = (route.min(axis=0) + route.max(axis=0)) / 2
    # The sky, which goes with the camera, hides what is far away.
    away_m = float(np.clip(np.ptp(route, axis=0).max(), *_AERIAL_M))
    eye = (float(middle[0]), float(middle[1]) - _AERIAL_BACK * away_m, _AERIAL_UP * away_m)
    return eye, (float(middle[0]), float(middle[1]), 0.0)


def world_map(world: World, places: list[tuple[float, Pose]]) -> Figure:
    """Return the map of a world with its route, and the viewpoints by number."""
    from matplotlib.figure import Figure  # noqa: PLC0415 - takes as long to load as all the rest

    from services.simulator.world.map_view import draw_map  # noqa: PLC0415 - see above

    figure = Figure(figsize=(10, 10), layout="constrained")
    axes = figure.add_subplot()
    draw_map(world, axes)
    route = plan_route(world, (world.start.x, world.start.y))
    axes.plot(*route.T, color="#d6602d", lw=1.8, zorder=3, label=f"route, {route_length_m(route):.0f} m")
    for number, (_, pose) in enumerate(places):
        axes.annotate(str(number), (pose.x, pose.y), fontsize=8, zorder=5, ha="center", va="center",
                      bbox={"boxstyle": "circle,pad=0.15", "fc": "white", "ec": "#d6602d", "lw": 0.8})  # fmt: skip
    axes.legend(loc="upper right")
    axes.set_title(world.name)
    return figure


def _write(path: Path, image: NDArray[np.uint8]) -> None:
    import cv2  # noqa: PLC0415 - takes long to load, and few commands need it

    good, data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    if not good:
        raise JobError(f"{path}: the picture cannot be encoded")
    path.write_bytes(data.tobytes())
