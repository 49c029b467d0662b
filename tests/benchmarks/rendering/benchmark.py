"""Rendering: the time of a frame of each scene over that of a trivial one, and the time of building the scene.

Trivial is a field with one house under the same sky, by the same renderer. All scenes take turns, a frame each, so that
what else the machine does is shared by all; the poses of a scene lie along its planned route. The time of a frame goes
from the pose to the picture in memory. A ratio is the median over turns of the ratio within a turn; processor time
counts the threads of a software driver as well, and is what to compare on a busy machine.

For comparison the trivial scene is drawn by SAPIEN's own shaders too, each in a process of its own. These frames take
no turns with the others, so that their ratios mean something on a quiet machine only.
"""

from __future__ import annotations

import gc
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import shapely
from numpy.typing import NDArray
from tqdm import tqdm

from services.kit.errors import JobError, UsageError
from services.simulator.scene.rendering import SceneCamera
from services.simulator.scene.vulkan import RenderingUnavailableError
from services.simulator.sensors.camera import CameraSettings
from services.simulator.world import Pose, World, WorldError, known_worlds, load_world
from services.simulator.world.route import plan_route
from services.simulator.world.terrain import Terrain
from tests.benchmarks.command_line import Parser, say
from tests.benchmarks.machine import machine
from tests.benchmarks.rendering.towns import field, town
from tests.benchmarks.results import Record, table

#: A map of about 400 buildings is judged: at this size, at most so many times the time of the trivial scene.
_JUDGED_BUILDINGS: Final = range(380, 421)
_JUDGED_SIZE: Final = (1024, 768)
_LIMIT: Final = 1.5
_TRIVIAL: Final = "trivial"
_CHECKOUT: Final = Path(__file__).parents[3]
_STOCK_SHADERS: Final = ("minimal", "default")


@dataclass(frozen=True)
class Plan:
    """How much is measured; the default is the full run.

    Parameters
    ----------
    turns : int
        Of all scenes, after one that is not counted.
    sizes : tuple of (int, int)
        Of the pictures, pixels.
    poses : int
        Along the route of each scene, one after the other.
    """

    turns: int = 60
    sizes: tuple[tuple[int, int], ...] = ((320, 240), (640, 480), (1024, 768))
    poses: int = 12


QUICK: Final = Plan(turns=12, sizes=(_JUDGED_SIZE,))


def scenes(map_file: Path | None) -> dict[str, World]:
    """Return the worlds to measure by name, the trivial one first.

    Raises
    ------
    UsageError
        The map cannot be used.
    """
    found = {_TRIVIAL: field()} | {name: load_world(name) for name in known_worlds()}
    found |= {f"town of {count}": town(count) for count in (400, 1000)}
    if map_file is not None:
        try:
            found[map_file.stem] = load_world(map_file)
        except WorldError as error:
            raise UsageError(f"--map {error}") from None
    return found


def benchmark(worlds: Mapping[str, World], plan: Plan) -> dict[str, Any]:
    """Measure every scene at every size; return what the JSON file holds."""
    rows: list[Record] = []
    stock: list[Record] = []
    with tqdm(total=len(plan.sizes) * (len(worlds) + plan.turns), desc="rendering", dynamic_ncols=True) as bar:
        for size in plan.sizes:
            rows += _measure(worlds, size, plan, bar)
            stock += [_stock(shader, size, plan.turns) for shader in _STOCK_SHADERS]
    return {
        "benchmark": "rendering",
        "machine": machine(),
        "plan": vars(plan),
        "frames": rows,
        "stock": stock,
        "targets": [_judge(row) for row in rows if _is_judged(row)],
    }


def _measure(worlds: Mapping[str, World], size: tuple[int, int], plan: Plan, bar: tqdm[Any]) -> list[Record]:
    cameras: dict[str, SceneCamera] = {}
    built_s: dict[str, float] = {}
    for name, world in worlds.items():
        bar.set_postfix_str(f"{size[0]}x{size[1]}, building {name}")
        began_s = time.perf_counter()
        cameras[name] = SceneCamera(world, CameraSettings(*size))
        built_s[name] = time.perf_counter() - began_s
        bar.update()
    poses = {name: _along(world, plan.poses) for name, world in worlds.items()}
    times = np.zeros((plan.turns + 1, len(worlds), 2))
    for turn in range(plan.turns + 1):
        for number, (name, camera) in enumerate(cameras.items()):
            times[turn, number] = _frame(camera, poses[name][turn % plan.poses])
        if turn:
            bar.update()
    del cameras
    gc.collect()
    return [
        _figures(name, world, size, built_s[name], times[1:, [0, number]])
        for number, (name, world) in enumerate(worlds.items())
    ]


def _stock(shader: str, size: tuple[int, int], frames: int) -> Record:
    """Measure the trivial scene by one of SAPIEN's shaders."""
    arguments = [shader, *map(str, size), str(frames)]
    command = [sys.executable, "-P", "-m", "tests.benchmarks.rendering.stock", *arguments]
    path = os.pathsep.join(filter(None, [str(_CHECKOUT), os.environ.get("PYTHONPATH")]))
    environment = os.environ | {"PYTHONPATH": path}
    answer = subprocess.run(command, check=False, capture_output=True, text=True, env=environment)
    if answer.returncode:
        last = answer.stderr.strip().splitlines()[-1:] or ["no message"]
        raise JobError(f"SAPIEN's shader {shader} cannot be measured: {last[0]}")
    wall_ms, processor_ms = np.median(json.loads(answer.stdout.splitlines()[-1]), axis=0)
    return {
        "shader": shader,
        "size": f"{size[0]}x{size[1]}",
        "median_ms": float(wall_ms),
        "processor_ms": float(processor_ms),
    }


def _frame(camera: SceneCamera, pose: Pose) -> tuple[float, float]:
    """Render one frame; return wall and processor time in milliseconds."""
    began_s, began_busy_s = time.perf_counter(), time.process_time()
    camera.render(pose)
    return 1e3 * (time.perf_counter() - began_s), 1e3 * (time.process_time() - began_busy_s)


def _along(world: World, count: int) -> list[Pose]:
    """Return poses evenly along the planned route, looking ahead; around the house where there is nowhere to go."""
    if not world.place.lanes:
        angles = np.linspace(0.0, math.tau, count, endpoint=False)
        return [Pose(-20 * math.cos(angle), -20 * math.sin(angle), float(angle)) for angle in angles]
    route = shapely.LineString(plan_route(world, (world.start.x, world.start.y)))
    poses = []
    for metres in np.linspace(0.0, route.length - 1.0, count):
        here, there = (shapely.get_coordinates(route.interpolate(along))[0] for along in (metres, metres + 0.5))
        poses.append(Pose(float(here[0]), float(here[1]), math.atan2(*(there - here)[::-1])))
    return poses


def _figures(name: str, world: World, size: tuple[int, int], built_s: float, times: NDArray[np.float64]) -> Record:
    """Summarize times (turns, 2, 2): the trivial scene and this one, wall and processor milliseconds."""
    ratios = np.median(times[:, 1] / times[:, 0], axis=0)
    return {
        "scene": name,
        "size": f"{size[0]}x{size[1]}",
        "buildings": len(world.place.buildings) if isinstance(world.place, Terrain) else 0,
        "build_s": built_s,
        "median_ms": float(np.median(times[:, 1, 0])),
        "best_ms": float(times[:, 1, 0].min()),
        "processor_ms": float(np.median(times[:, 1, 1])),
        "ratio": float(ratios[0]),
        "processor_ratio": float(ratios[1]),
    }


def _is_judged(row: Record) -> bool:
    return row["size"] == f"{_JUDGED_SIZE[0]}x{_JUDGED_SIZE[1]}" and row["buildings"] in _JUDGED_BUILDINGS


def _judge(row: Record) -> Record:
    ratio = float(str(row["ratio"]))
    return {
        "target": f"{row['scene']} over trivial, {row['size']}",
        "measured": ratio,
        "limit": f"at most {_LIMIT:g}",
        "verdict": "met" if ratio <= _LIMIT else "not met",
    }


def as_text(results: dict[str, Any]) -> str:
    """Write the tables."""
    rows = [
        {"scene": f["scene"], "size": f["size"], "buildings": f["buildings"], "build s": f["build_s"],
         "ms": f["median_ms"], "best ms": f["best_ms"], "processor ms": f["processor_ms"], "ratio": f["ratio"],
         "processor ratio": f["processor_ratio"]}
        for f in results["frames"]
    ]  # fmt: skip
    return (
        table("A frame of each scene", rows)
        + table("The trivial scene by SAPIEN's own shaders, and each scene over it", _over_stock(results))
        + table("Targets", results["targets"])
    )


def _over_stock(results: dict[str, Any]) -> list[Record]:
    return [
        {"scene": _TRIVIAL, "shader": stock["shader"], "size": stock["size"], "ms": stock["median_ms"]}
        | {
            f"{frame['scene']} / it": frame["median_ms"] / stock["median_ms"]
            for frame in results["frames"]
            if frame["size"] == stock["size"]
        }
        for stock in results["stock"]
    ]


def main(arguments: list[str]) -> None:
    """Read the flags, measure, print and write."""
    parser = Parser("rendering", __doc__)
    parser.add_argument("--map", type=Path, metavar="FILE", help="a map or world file to measure as well")
    flags = parser.parse(arguments)
    try:
        results = benchmark(scenes(flags.map), QUICK if flags.quick else Plan())
    except RenderingUnavailableError as error:
        raise JobError(str(error)) from None
    say(flags, results, as_text(results))
