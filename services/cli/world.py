"""``smal world``: create worlds from maps, and draw worlds."""

import math
import re
import time
from collections.abc import Iterable
from contextlib import ExitStack, closing
from dataclasses import asdict
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import numpy as np
import shapely
import typer
from numpy.typing import NDArray
from pydantic import TypeAdapter
from typer import Argument, Option

from services.cli import options, outputs
from services.cli.grouping import STYLE, grouped
from services.experiments.html import png
from services.experiments.progress import Bars, bar_of
from services.experiments.words import counted, table
from services.kit.errors import UsageError
from services.kit.world_files import scan_format
from services.simulator.sensors.camera import CameraSettings
from services.simulator.world import Pose, World, WorldError
from services.simulator.world.loading import RoleWishes, Wishes, bounded, import_map
from services.simulator.world.osm import MapSurroundings
from services.simulator.world.route import lane_graph, plan_route, route_length_m
from services.simulator.world.scan import MESH_SUFFIX, Axis, RobotName, scan_text
from services.simulator.world.terrain import Terrain
from smal.files.confined import ConfinedError, Work
from smal.files.container import write_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from services.simulator.scene.rendering import SceneCamera

app = typer.Typer(
    help="Create and draw worlds.\n\nExample: smal world import map.osm --out town.json", **STYLE
)

_NUMBER = r"[-+]?\d+(?:\.\d+)?"
# Look-ahead of a view along the route; at a corner it looks where the robot turns.
_AHEAD_M: Final = 1.0
# Distance of the last view to the victim, as a fraction of the distance that counts as found.
_BEFORE_VICTIM: Final = 0.9
_MOST_VIEWS: Final = 200


@app.command("import")
def import_world(
    source: Annotated[
        Path,
        Argument(
            metavar="FILE",
            help="OpenStreetMap extract (XML, .gz, .bz2 or .pbf), or scan (.glb, .gltf, .obj, .ply).",
        ),
    ],
    out: Annotated[Path, Option(help="World file, ending in .json.")],
    start: Annotated[
        str | None,
        Option("--start", "--from", metavar="X,Y[,HEADING_DEG]", help="Start of the robot."),
    ] = None,
    victim: Annotated[
        str | None,
        Option("--victim", "--to", metavar="X,Y[,HEADING_DEG]", help="Position of the victim."),
    ] = None,
    seed: Annotated[int, Option(min=0, help="Seed of start and victim; see above.")] = 0,
    around: Annotated[
        str | None, Option(metavar="LAT,LON", help="Centre of the part to import.")
    ] = None,
    radius: Annotated[
        float | None,
        Option(min=50, max=5000, metavar="M", help="Half the side of the part to import."),
    ] = None,
    scale: Annotated[
        float | None,
        Option(
            min=1e-6, max=1e3, metavar="M", help="Length of a unit of a scan in metres (0.01 = cm)."
        ),
    ] = None,
    up: Annotated[Axis | None, Option(help="Up axis of a scan.")] = None,
    floor: Annotated[
        float | None, Option(metavar="M", help="Height of the floor in a scan with several floors.")
    ] = None,
    robot: Annotated[RobotName | None, Option(help="Robot for a scan.")] = None,
    step: Annotated[
        float | None,
        Option(min=0.01, max=1.0, metavar="M", help="Step in a scan that the robot can climb."),
    ] = None,
) -> None:
    """Convert an OpenStreetMap extract or a scan of a real place to a world.

    Map: buildings (with courtyards, parts, roofs), roads with sidewalks and markings, water, woods,
    trees and barriers become a terrain. Invalid objects are left out and counted.

    Scan: the largest connected floor on which the robot fits becomes the world. Unit and up axis
    are detected and reported. The file FILE.npz beside the world file holds the meshes.

    Start and victim come from the map's smal:role nodes, or are chosen by --seed: the victim beside
    a wall near the middle, the start a long way away without a view of the victim. X and Y are
    metres east and north of the map's middle, or of the south-west corner of a scan's floor;
    headings are degrees anticlockwise from east. To move the victim later, edit its x and y in the
    JSON file.

    Examples
    --------
    smal world import map.osm --out town.json --seed 3
    smal world import house.glb --out house.json --from 1,2 --to 6,3.5
    """
    began_s = time.perf_counter()
    if out.suffix != ".json":
        raise UsageError(f"--out {out}: unsupported; the file name must end in .json")
    outputs.check_file(out, "--out")
    wanted = "X,Y or X,Y,HEADING_DEG"
    task = RoleWishes(
        start=_pose("--start", start, wanted),
        victim=_pose("--victim", victim, wanted),
        ahead=start is not None and start.count(",") == 1,
        seed=seed,
    )
    options.existing(source)
    # The file of a page has no name.
    inherited = re.fullmatch(r"/proc/self/fd/(\d+)", str(source))
    descriptors = (int(inherited[1]),) if inherited else ()
    request: dict[str, Any] = {"source": str(source), "out": str(out)}
    with ExitStack() as files:
        request["file"] = files.enter_context(outputs.writing(out, "--out")).name
        if scan_format(source) is not None:
            options.refuse({"around": around, "radius": radius}, "for a scan; leave it out")
            request["wishes"] = _scan_wishes(task, scale, up, floor, robot, step)
            mesh = outputs.writing(out.with_suffix(MESH_SUFFIX), "--out")
            request["mesh"] = files.enter_context(mesh).name
            function = "services.cli.world:make_from_scan"
        else:
            of_scans = {"scale": scale, "up": up, "floor": floor, "robot": robot, "step": step}
            options.refuse(of_scans, "for a map; leave it out")
            request["wishes"] = asdict(Wishes(task, _surroundings(around, radius)))
            function = "services.cli.world:make"
        bars = files.enter_context(closing(Bars()))
        rows = bounded(function, request, source, descriptors, lambda stage: bars(*stage))
    rows.append(("time", f"{time.perf_counter() - began_s:.1f} s"))
    for line in table(rows, left=1):
        typer.echo(line)
    typer.echo(f"wrote {out}; next: smal demonstrate --world {out} --out DIR")


def _scan_wishes(task: RoleWishes, *choices: float | str | None) -> dict[str, Any]:
    names = ("scale", "up", "floor_m", "robot", "climb_m")
    return {"task": asdict(task)} | dict(zip(names, choices, strict=True))


def make(request: dict[str, Any], _work: Work) -> list[tuple[str, str]]:
    """Create a world file from a map in a child process and return its summary."""
    wishes = TypeAdapter(Wishes).validate_python(request["wishes"])
    try:
        imported, text = import_map(Path(request["source"]), Path(request["out"]), wishes)
    except WorldError as error:
        raise ConfinedError(str(error)) from None
    Path(request["file"]).write_text(text)
    return list(_summary(imported))


def make_from_scan(request: dict[str, Any], work: Work) -> list[tuple[str, str]]:
    """Create a world file and a mesh file from a scan in a child process; see `make`."""
    from services.simulator.scanning.importing import ScanWishes, import_scan  # noqa: PLC0415 - trimesh is optional
    from services.simulator.scanning.mesh_file import write_parts  # noqa: PLC0415

    source = Path(request["source"])
    wishes = TypeAdapter(ScanWishes).validate_python(request["wishes"])
    try:
        imported = import_scan(source, wishes, lambda *stage: work.tell(stage))
    except WorldError as error:
        raise ConfinedError(str(error)) from None
    Path(request["file"]).write_text(scan_text(imported.world, source.name))
    with Path(request["mesh"]).open("wb") as file:
        write_parts(file, imported.parts)
    return list(imported.summary)


def _numbers(option: str, text: str, wanted: str, counts: tuple[int, ...]) -> list[float]:
    numbers = (
        [float(part) for part in text.split(",")]
        if re.fullmatch(rf"{_NUMBER}(,{_NUMBER})*", text)
        else []
    )
    if len(numbers) not in counts or not all(map(math.isfinite, numbers)):
        raise UsageError(f"{option} {text!r}: invalid; expected {wanted}")
    return numbers


def _pose(option: str, text: str | None, wanted: str) -> Pose | None:
    if text is None:
        return None
    numbers = _numbers(option, text, f"{wanted}, for example 12.5,-3,90", (2, 3))
    x, y, heading_deg = (*numbers, 0.0)[:3]
    return Pose(x, y, math.remainder(math.radians(heading_deg), math.tau))


def _surroundings(around: str | None, radius: float | None) -> MapSurroundings | None:
    if around is None and radius is None:
        return None
    if around is None or radius is None:
        raise UsageError("--around LAT,LON and --radius METRES: give both")
    latitude, longitude = _numbers(
        "--around", around, "LAT,LON in degrees, for example 39.751,-105.223", (2,)
    )
    if not (abs(latitude) <= 85 and abs(longitude) <= 180):
        raise UsageError(
            f"--around {around!r}: outside latitude -85 to 85 or longitude -180 to 180 degrees"
        )
    return MapSurroundings(latitude, longitude, radius)


def _summary(world: World) -> Iterable[tuple[str, str]]:
    terrain = world.place
    assert isinstance(terrain, Terrain)  # noqa: S101 - of a map
    assert terrain.source is not None  # noqa: S101
    source = terrain.source
    x_min, y_min, x_max, y_max = terrain.bounds
    yield "size", f"{x_max - x_min:.0f} x {y_max - y_min:.0f} m"
    yield "roads", f"{sum(road.line.length for road in terrain.roads) / 1000:.2f} km"
    yield "  drivable and connected", f"{sum(lane.length for lane in terrain.lanes) / 1000:.2f} km"
    yield "  points of the graph", f"{len(lane_graph(terrain).points)}"
    counts = [
        ("buildings", len(terrain.buildings)),
        ("  from relations", source.used.get("building relation", 0)),
        ("  drawn as their parts", source.used.get("building part", 0)),
        ("trees", len(terrain.trees)),
        ("areas", len(terrain.areas)),
        ("barriers", len(terrain.barriers)),
        ("skipped", sum(source.skipped.values())),
        *((f"  {reason}", count) for reason, count in source.skipped.items()),
        ("left out", sum(source.left_out.values())),
        *((f"  {reason}", count) for reason, count in source.left_out.items()),
    ]
    yield from ((name, str(count)) for name, count in counts)
    yield "route", f"{route_length_m(plan_route(world, (world.start.x, world.start.y))):.1f} m"


@app.command("render")
@grouped
def render(
    name: Annotated[
        str, Argument(metavar="WORLD", help="Name of a world, or file of a map or world.")
    ],
    out: Annotated[Path, Option(help="Folder for the pictures.")] = Path("views"),
    views: Annotated[
        int, Option(min=2, max=_MOST_VIEWS, help="Number of pictures along the route.")
    ] = 6,
    camera: options.CameraSize = None,
    at_work: options.AtWork = options.HERE,
) -> None:
    """Draw a world: map.png with the planned route, and camera views along the route.

    Views are named view-NN-DISTANCEm.png by their distance along the route, from the start to the
    victim. With --workers or --scheduler each worker opens the world, which takes seconds.

    Example: smal world render campus --out campus-views --views 8
    """
    size = camera or options.USUAL_CAMERA
    world = options.read_world(name, "")
    outputs.make_folder(out, "--out")
    from matplotlib.image import imsave  # noqa: PLC0415 - takes long to load

    places = viewpoints(world, views)
    write_whole(out / "map.png", png(world_map(world, places), dpi=150))
    seen = _Seen(world, CameraSettings(size.width, size.height))
    poses = [pose for _, pose in places]
    with at_work.engine() as engine:
        pictures = map(seen, poses) if at_work == options.HERE else engine.map(seen, poses)
        bar = bar_of(
            zip(places, pictures, strict=True), desc="rendering", total=views, unit="picture"
        )
        for number, ((metres, _), picture) in enumerate(bar):
            content = BytesIO()
            imsave(content, picture, format="png")
            write_whole(out / f"view-{number:02d}-{metres:.0f}m.png", content.getvalue())
    typer.echo(f"wrote the map and {counted(views, 'view')} in {out}")


def viewpoints(world: World, views: int) -> list[tuple[float, Pose]]:
    """Return evenly spaced viewpoints along the route and their distances, metres.

    The last viewpoint faces the victim.
    """
    route = shapely.LineString(plan_route(world, (world.start.x, world.start.y)))
    before = min(_BEFORE_VICTIM * world.scale.found_m, route.length / 2)
    along = np.linspace(0.0, route.length - before, views)
    here, there = (
        shapely.get_coordinates(route.interpolate(along + ahead)) for ahead in (0.0, _AHEAD_M)
    )
    there[-1] = world.victim.x, world.victim.y
    headings = np.arctan2(*(there - here).T[::-1])
    poses = [world.start, *(Pose(*one) for one in np.column_stack([here, headings])[1:].tolist())]
    return list(zip(along.tolist(), poses, strict=True))


class _Seen:
    """Camera in a world, opened on first use because that takes seconds."""

    def __init__(self, world: World, settings: CameraSettings) -> None:
        self._opened = world, settings
        self._eye: SceneCamera | None = None

    def __call__(self, pose: Pose) -> NDArray[np.uint8]:
        from services.simulator.scene.rendering import SceneCamera  # noqa: PLC0415 - loads the renderer

        self._eye = self._eye or SceneCamera(*self._opened)
        return self._eye.render(pose)


def world_map(world: World, places: list[tuple[float, Pose]]) -> "Figure":
    """Return a map of a world with its route and the numbered viewpoints."""
    from matplotlib.figure import Figure  # noqa: PLC0415 - takes as long to load as all the rest

    from services.simulator.world.map_view import draw_map  # noqa: PLC0415 - see above

    figure = Figure(figsize=(10, 10), layout="constrained")
    axes = figure.add_subplot()
    draw_map(world, axes)
    route = plan_route(world, (world.start.x, world.start.y))
    axes.plot(
        *route.T, color="#d6602d", lw=1.8, zorder=3, label=f"route, {route_length_m(route):.0f} m"
    )
    for number, (_, pose) in enumerate(places):
        axes.annotate(str(number), (pose.x, pose.y), fontsize=8, zorder=5, ha="center", va="center",
                      bbox={"boxstyle": "circle,pad=0.15", "fc": "white", "ec": "#d6602d", "lw": 0.8})  # fmt: skip
    axes.legend(loc="upper right")
    axes.set_title(world.name)
    return figure
