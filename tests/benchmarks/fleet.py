"""Fleet: 1, 2, 4 and 8 simulated robots (160x120) run at once on this machine, on one map.

Each has its simulator, and features, recognition and policy are one process each. They run in lockstep, where time
waits for answers, and in real time, where it waits for nobody, at as many frames a second as --hz says (without a depth
camera where that is too few for one). Told are: how many find their victim, their frames a second, the decisions'
latency, and what the shared processes hold and take a frame. With --out a picture of it is drawn, fleet.png.
"""

import argparse
import json
import os
import statistics
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure

from services.cli import options
from services.cli.stack import Stack, StackPlan, flags, free_endpoint
from services.experiments.colours import COLOURS, MUTED
from services.experiments.drawing import legend, styled
from services.kit.errors import JobError
from tests.benchmarks.faults.benchmark import taught_model
from tests.benchmarks.faults.rig import CAMERA, WORLD
from tests.benchmarks.reporting import Parser, Record, folder_for, say, table, used
from tests.command import run_smal

MANY: Final = (1, 2, 4, 8)
QUICK: Final = (1, 2)
_SHARED: Final = ("features", "recognition", "policy")
_DEPTH_HZ: Final = 4.0  # A depth image is too old to drive by after a quarter of a second.
_VALID_MS: Final = 500.0  # So is the answer to a frame after half a one: the robot stands until the next comes in time.
HZ: Final = 2.0  # What two cores can do for eight robots, simulation included.


def benchmark(counts: Sequence[int], model: Path, folder: Path, hz: float) -> dict[str, Any]:
    """Run so many robots, one count after the other, in lockstep and in real time; return what the JSON file holds."""
    fleets = {
        title: [_measured(count, model, folder / f"{title}-{count}", rate) for count in counts]
        for title, rate in (("in lockstep", None), (f"in real time, {hz:g} frames a second", hz))
    }
    return {"benchmark": "fleet", "hz": hz, "fleets": fleets}


def _measured(robots: int, model: Path, folder: Path, hz: float | None) -> Record:
    width, height = CAMERA
    rate = {} if hz is None else {"frames_hz": hz, "depth": str(hz >= _DEPTH_HZ).lower()}
    own = {"robot": flags(world=WORLD, camera_width=width, camera_height=height, **rate),
           **dict.fromkeys(("recognition", "policy"), flags(root=model.parent))}  # fmt: skip
    plan = StackPlan(
        ("router", "robot", *_SHARED), "fleet", free_endpoint(), own, logs=folder, robots=robots
    )
    with Stack(plan) as stack, ThreadPoolExecutor(robots) as pool:
        before = _used(stack)
        began_s = time.monotonic()

        def run(robot: str) -> dict[str, Any]:
            out = folder / f"{robot}.json"
            seed = plan.fleet.index(robot) + 1
            command = ["run", "--model", model, "--world", WORLD, "--episodes", 1, "--seed", seed, "--json", out,
                       "--connect", plan.endpoint, "--robot", robot, *(["--realtime"] if hz else [])]  # fmt: skip
            done = run_smal(*command)
            if done.returncode:
                raise JobError(f"{robot}: {done.stderr.strip().splitlines()[-1]}")
            found: dict[str, Any] = json.loads(out.read_text())
            return found

        runs = list(pool.map(run, plan.fleet))
        seconds = time.monotonic() - began_s
        after = _used(stack)
    frames = sum(one["episodes"][0]["ticks"] for one in runs)
    latencies = [one["decision_latency_ms"] for one in runs]
    return {
        "robots": robots,
        "found": sum(one["episodes"][0]["outcome"] == "found" for one in runs),
        "frames_hz": frames / seconds,
        "p50_ms": statistics.median(one["p50"] for one in latencies),
        "p95_ms": max(one["p95"] for one in latencies),
        **{f"{name}_mb": after[name][0] / 1e6 for name in _SHARED},
        **{f"{name}_ms": 1e3 * (after[name][1] - before[name][1]) / frames for name in _SHARED},
        "load": os.getloadavg()[0],
    }


def _used(stack: Stack) -> dict[str, tuple[float, float]]:
    return {name: used(stack.pid(name)) for name in _SHARED}


@styled
def growth(fleets: dict[str, list[dict[str, Any]]]) -> Figure:
    """Draw frames a second, the decisions' latency and memory over the number of robots."""
    drawn = Figure(figsize=(11.0, 3.2))
    rates, latencies, memory = drawn.subplots(1, 3)
    beside: dict[str, Any] = {"xytext": (4, -11), "textcoords": "offset points", "fontsize": 8}
    for (title, of_each), colour in zip(fleets.items(), COLOURS, strict=False):
        robots, frames_hz, worst_ms, found, *held = (
            [one[name] for one in of_each]
            for name in (
                "robots",
                "frames_hz",
                "p95_ms",
                "found",
                *(f"{name}_mb" for name in _SHARED),
            )
        )
        for axes, values in ((rates, frames_hz), (latencies, worst_ms), (memory, np.sum(held, 0))):
            axes.plot(robots, values, "o-", color=colour, label=title)
        for count, *at in zip(found, robots, frames_hz, strict=True):
            rates.annotate(f"{count} found", at, **beside)
    latencies.axhline(_VALID_MS, color=MUTED, ls="--", lw=1.0)
    rates.set_title("frames a second, of all robots together")
    latencies.set_title("95th percentile of decisions, slowest robot, ms")
    memory.set_title("features, recognition and policy, MB")
    for axes in (rates, latencies, memory):
        axes.set(xlabel="robots", ylim=(0, None), xticks=robots)
    legend(drawn, [rates])
    return drawn


def main(arguments: list[str]) -> None:
    """Read the flags, drive, print, draw and write."""
    parser = Parser("fleet", __doc__)
    parser.add_model()
    parser.add_argument(
        "--hz", type=_hz, default=HZ, metavar="R", help=f"in real time (default {HZ:g})"
    )
    chosen = parser.parse(arguments)
    if chosen.model is not None:
        options.read_model(chosen.model, options.Use("filter"))
    with folder_for(chosen.out) as folder:
        model = (chosen.model or taught_model(folder / "taught")).resolve()
        results = benchmark(QUICK if chosen.quick else MANY, model, folder, chosen.hz)
    if chosen.out is not None:
        growth(results["fleets"]).savefig(chosen.out / "fleet.png", dpi=130)
    tables = (table(f"robots at once, {title}; _ms is processor time a frame", rows)
              for title, rows in results["fleets"].items())  # fmt: skip
    say(chosen, results, "".join(tables))


def _hz(text: str) -> float:
    hz = float(text)
    if not 1.0 <= hz <= 10.0:
        raise argparse.ArgumentTypeError("1 to 10")
    return hz
