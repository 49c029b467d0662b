"""Rendering: the time of a frame of each scene over that of a trivial one.

Trivial is a field with one house under the same sky, by the same renderer. All scenes take turns, a frame each, so that
what else the machine does is shared by all; the poses of a scene lie along its planned route. The time of a frame goes
from the pose to the picture in memory. A ratio is the median over turns of the ratio within a turn.

For comparison the trivial scene is drawn by SAPIEN's own shaders too, each in a process of its own. These frames take
no turns with the others, so that their times mean something on a quiet machine only.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import shapely
from tqdm import tqdm

from services.kit.errors import JobError, UsageError
from services.simulator.scene.rendering import SceneCamera
from services.simulator.scene.vulkan import RenderingUnavailableError
from services.simulator.sensors.camera import CameraSettings
from services.simulator.world import Pose, World, WorldError, load_world
from services.simulator.world.route import plan_route
from tests.benchmarks.command_line import Parser, say
from tests.benchmarks.machine import machine
from tests.benchmarks.rendering.towns import field, town
from tests.benchmarks.results import Record, table

_TRIVIAL: Final = "trivial"
_CHECKOUT: Final = Path(__file__).parents[3]
_STOCK_SHADERS: Final = ("minimal", "default")
_SIZE: Final = (1024, 768)
#: Of all scenes, after one that is not counted.
_TURNS, _QUICK_TURNS = 60, 12
#: Poses along the route of each scene, one after the other.
_POSES: Final = 12


def scenes(map_file: Path | None) -> dict[str, World]:
    """Return the worlds to measure by name, the trivial one first.

    Raises
    ------
    UsageError
        The map cannot be used.
    """
    found = {_TRIVIAL: field()} | {name: load_world(name) for name in ("campus", "indoor")}
    found |= {f"town of {count}": town(count) for count in (400, 1000)}
    if map_file is not None:
        try:
            found[map_file.stem] = load_world(map_file)
        except WorldError as error:
            raise UsageError(f"--map {error}") from None
    return found


def benchmark(worlds: Mapping[str, World], turns: int, size: tuple[int, int] = _SIZE) -> dict[str, Any]:
    """Measure every scene in pictures of a size, pixels; return what the JSON file holds."""
    cameras = {name: SceneCamera(world, CameraSettings(*size)) for name, world in worlds.items()}
    poses = {name: _along(world, _POSES) for name, world in worlds.items()}
    times = np.array([
        [_frame_ms(camera, poses[name][turn % _POSES]) for name, camera in cameras.items()]
        for turn in tqdm(range(turns + 1), desc="rendering", dynamic_ncols=True)
    ])[1:]  # fmt: skip
    medians, ratios = np.median(times, axis=0), np.median(times / times[:, :1], axis=0)
    frames = [
        {"scene": name, "ms": float(ms), "ratio": float(ratio)}
        for name, ms, ratio in zip(worlds, medians, ratios, strict=True)
    ]
    stock = [_stock(shader, size, turns) for shader in _STOCK_SHADERS]
    return {"benchmark": "rendering", "machine": machine(), "size": size, "frames": frames, "stock": stock}


def _stock(shader: str, size: tuple[int, int], frames: int) -> Record:
    """Measure the trivial scene by one of SAPIEN's shaders."""
    arguments = [shader, *map(str, size), str(frames)]
    command = [sys.executable, "-P", "-m", "tests.benchmarks.rendering.stock", *arguments]
    path = os.pathsep.join(filter(None, [str(_CHECKOUT), os.environ.get("PYTHONPATH")]))
    answer = subprocess.run(command, check=False, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": path})
    if answer.returncode:
        last = answer.stderr.strip().splitlines()[-1:] or ["no message"]
        raise JobError(f"SAPIEN's shader {shader} cannot be measured: {last[0]}")
    return {"scene": _TRIVIAL, "shader": shader, "ms": float(np.median(json.loads(answer.stdout.splitlines()[-1])))}


def _frame_ms(camera: SceneCamera, pose: Pose) -> float:
    """Render one frame."""
    began_s = time.perf_counter()
    camera.render(pose)
    return 1e3 * (time.perf_counter() - began_s)


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


def main(arguments: list[str]) -> None:
    """Read the flags, measure, print and write."""
    parser = Parser("rendering", __doc__)
    parser.add_argument("--map", type=Path, metavar="FILE", help="a map or world file to measure as well")
    flags = parser.parse(arguments)
    try:
        results = benchmark(scenes(flags.map), _QUICK_TURNS if flags.quick else _TURNS)
    except RenderingUnavailableError as error:
        raise JobError(str(error)) from None
    say(
        flags,
        results,
        table("A frame of each scene, 1024x768", results["frames"])
        + table("The trivial scene by SAPIEN's own shaders", results["stock"]),
    )
