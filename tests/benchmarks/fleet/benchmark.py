"""Fleet: 1, 2, 4 and 8 simulated robots (160x120) run at once on this machine, on one map.

Each has its simulator, and features, recognition and policy are one process each. Told are: how many find their victim,
their frames a second, the decisions' latency, and what the shared processes hold and take a frame.
"""

import json
import os
import statistics
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final

from services.cli import options
from services.cli.stack import Stack, StackPlan, flags, free_endpoint
from services.kit.errors import JobError
from tests.benchmarks.faults.benchmark import taught_model
from tests.benchmarks.faults.rig import CAMERA, WORLD
from tests.benchmarks.reporting import Parser, Record, folder_for, say, table
from tests.command import run_smal

MANY: Final = (1, 2, 4, 8)
QUICK: Final = (1, 2)
_SHARED: Final = ("features", "recognition", "policy")
_TICKS_S: Final = os.sysconf("SC_CLK_TCK")


def benchmark(counts: tuple[int, ...], model: Path, folder: Path, *, realtime: bool) -> dict[str, Any]:
    """Run so many robots, one count after the other; return what the JSON file holds."""
    fleets = [_measured(count, model, folder / str(count), realtime=realtime) for count in counts]
    return {"benchmark": "fleet", "realtime": realtime, "fleets": fleets}


def _measured(robots: int, model: Path, folder: Path, *, realtime: bool) -> Record:
    width, height = CAMERA
    own = {"robot": flags(world=WORLD, camera_width=width, camera_height=height),
           **dict.fromkeys(("recognition", "policy"), flags(root=model.parent))}  # fmt: skip
    plan = StackPlan(("router", "robot", *_SHARED), "fleet", free_endpoint(), own, logs=folder, robots=robots)
    with Stack(plan) as stack, ThreadPoolExecutor(robots) as pool:
        before, began_s = _used(stack), time.monotonic()

        def run(robot: str) -> dict[str, Any]:
            out, seed = folder / f"{robot}.json", plan.fleet.index(robot) + 1
            command = ["run", "--model", model, "--world", WORLD, "--episodes", 1, "--seed", seed, "--json", out,
                       "--connect", plan.endpoint, "--robot", robot, *(["--realtime"] if realtime else [])]  # fmt: skip
            done = run_smal(*command)
            if done.returncode:
                raise JobError(f"{robot}: {done.stderr.strip().splitlines()[-1]}")
            found: dict[str, Any] = json.loads(out.read_text())
            return found

        runs = list(pool.map(run, plan.fleet))
        seconds, after = time.monotonic() - began_s, _used(stack)
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
    }


def _used(stack: Stack) -> dict[str, tuple[float, float]]:
    """Return the bytes that the shared processes hold, and the processor seconds that they have taken."""
    used = {}
    for name in _SHARED:
        proc = Path(f"/proc/{stack.pid(name)}")
        times = (proc / "stat").read_text().rpartition(")")[2].split()[11:13]
        pages = int((proc / "statm").read_text().split()[1])
        used[name] = pages * os.sysconf("SC_PAGE_SIZE") * 1.0, sum(map(int, times)) / _TICKS_S
    return used


def main(arguments: list[str]) -> None:
    """Read the flags, drive, print and write."""
    parser = Parser("fleet", __doc__)
    parser.add_model()
    parser.add_argument("--realtime", action="store_true", help="time waits for nobody")
    chosen = parser.parse(arguments)
    if chosen.model is not None:
        options.read_model(chosen.model, options.Use("filter"))
    with folder_for(chosen.out) as folder:
        model = (chosen.model or taught_model(folder / "taught")).resolve()
        results = benchmark(QUICK if chosen.quick else MANY, model, folder, realtime=chosen.realtime)
    title = "in real time" if chosen.realtime else "in lockstep"
    say(chosen, results, table(f"robots at once, {title}; _ms is processor time a frame", results["fleets"]))
