"""Decision latency: from the capture of the last frame to the command at the actuator, in real time.

The services features, recognition and policy run as processes on a router of their own. In place of the simulator a
recorded drive is shown to them at 10 Hz, and what the policy answers goes through the actuator's gate. The time goes
from before a frame is packed to the acceptance of its command; rendering is apart. With --watchers every camera is
measured twice, in turns drive by drive: with no page of the console, and with so many that watch, the first of which
takes nothing.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from tqdm import tqdm

from schemas.rpc import LoadReply, LoadRequest
from services.cli.options import Camera, read_model
from services.cli.stack.processes import Stack, StackPlan, flags, free_endpoint
from services.kit.errors import UsageError
from services.kit.jpeg import encode_jpeg
from services.kit.settings import ServiceSettings
from services.recordings.dataset import find_recordings
from tests.benchmarks.command_line import Parser, say
from tests.benchmarks.latency.drives import Frames, Way, drives, make, resized
from tests.benchmarks.latency.robot import Robot
from tests.benchmarks.latency.watchers import watching
from tests.benchmarks.machine import machine
from tests.benchmarks.results import table

SERVICES: Final = ("router", "features", "recognition", "policy")
_ROBOT: Final = "bench"
_LOADING_S: Final = 120.0


@dataclass(frozen=True)
class Plan:
    """What is measured; the default is the full run.

    Parameters
    ----------
    ticks : int
        Frames for each camera.
    cameras : sequence of Camera or None
        Sizes of the image; None is that of the recordings.
    episodes, recoveries : int
        Drives to make where no model is given.
    watchers : int
        Pages that watch in every second drive; 0 for no console at all.
    """

    ticks: int = 1000
    cameras: Sequence[Camera | None] = (None, Camera(1024, 768))
    episodes: int = 12
    recoveries: int = 60
    watchers: int = 0


def benchmark(plan: Plan, model: Path, recordings: Path, logs: Path) -> dict[str, Any]:
    """Measure every case; return what the JSON file holds."""
    endpoint, below = free_endpoint(), flags(root=model.resolve().parent)
    page = free_endpoint().removeprefix("tcp/") if plan.watchers else ""
    services = (*SERVICES, "console") if page else SERVICES
    own = {**dict.fromkeys(("recognition", "policy"), below), "console": (*below, *flags(console=page))}
    counts = [0, plan.watchers] if page else [0]
    total = plan.ticks * len(plan.cameras) * len(counts)
    with (
        Stack(StackPlan(services, _ROBOT, endpoint, own, logs=logs)) as stack,
        closing(Robot(ServiceSettings(robot=_ROBOT, router=endpoint))) as robot,
        tqdm(total=total, desc="driving", unit="frame", dynamic_ncols=True) as bar,
    ):
        cases = []
        loaded = _load(robot, model)
        for camera in plan.cameras:
            stack.check()
            sides = [Side(count) for count in counts]
            for k, (frames, way) in enumerate(_shown(recordings, camera, plan.ticks)):
                for side in sides:
                    side.measure(robot, f"bench-{len(cases)}-{k}-{side.watchers}", frames, way, page, bar)
            cases += [side.case(loaded) for side in sides]
    return {"benchmark": "latency", "machine": machine(), "ticks": plan.ticks, "cases": cases}


def _load(robot: Robot, model: Path) -> LoadReply:
    """Have recognition and policy load the model; return what both have loaded."""
    request, bus = LoadRequest(model=model.resolve().name), robot.node.bus
    bus.call("policy", "load", request, LoadReply, timeout_s=_LOADING_S)
    return bus.call("recognition", "load", request, LoadReply, timeout_s=_LOADING_S)


def _shown(recordings: Path, camera: Camera | None, ticks: int) -> Iterator[tuple[Frames, Way]]:
    """Give drives until there are enough frames."""
    for recorded, way in drives(recordings):
        if ticks <= 0:
            return
        yield resized(recorded[:ticks], camera), way[:ticks]
        ticks -= len(recorded)


@dataclass
class Side:
    """What is measured with so many pages that watch."""

    watchers: int
    taken_s: list[float | None] = field(default_factory=list)
    camera: str = ""

    def measure(self, robot: Robot, episode: str, frames: Frames, way: Way, page: str, bar: tqdm[Any]) -> None:
        """Show one drive."""
        height, width, _ = frames[0].shape
        self.camera = f"{width}x{height}"
        # Made before: who drives is not kept by it.
        pictures = [encode_jpeg(one) for one in frames] if page else None
        watched = watching(page, self.watchers) if self.watchers else nullcontext()
        with watched:
            self.taken_s += robot.drive(episode, frames, way, bar.update, pictures)

    def case(self, loaded: LoadReply) -> dict[str, Any]:
        """Return the figures."""
        facts = loaded.model_dump(include={"keyframes"})
        return {"camera": self.camera, "watchers": self.watchers} | facts | summary(self.taken_s)


def summary(taken_s: Sequence[float | None]) -> dict[str, Any]:
    """Give percentiles in milliseconds; a frame without a command took for ever, which is told as None."""
    taken = np.array([np.inf if one is None else 1e3 * one for one in taken_s] or [np.inf])
    marks = {f"p{mark}_ms": float(np.percentile(taken, mark, method="higher")) for mark in (50, 95)}
    known: dict[str, Any] = {name: value if np.isfinite(value) else None for name, value in marks.items()}
    return {"frames": len(taken_s), "missing": sum(one is None for one in taken_s)} | known


def main(arguments: list[str]) -> None:
    """Read the flags, measure, print and write."""
    flags = _parser().parse(arguments)
    if (flags.model is None) != (flags.recordings is None):
        raise UsageError("give both --model and --recordings, or neither")
    plan = _plan(flags)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="smal-bench-")))
        model, recordings = flags.model, flags.recordings
        if model is None:
            model, recordings = make(folder, plan.episodes, plan.recoveries), folder
        # What is wrong with the files is found out before services start.
        read_model(model, "filter", None)
        find_recordings([recordings])
        results = benchmark(plan, model, recordings, folder / "logs")
    say(flags, results, table("From the capture of a frame to its command", results["cases"]))


def _plan(flags: argparse.Namespace) -> Plan:
    shape = Plan(ticks=100, episodes=2, recoveries=2) if flags.quick else Plan()
    return Plan(
        flags.ticks or shape.ticks,
        [Camera.parse(size) for size in flags.camera] or shape.cameras,
        shape.episodes,
        shape.recoveries,
        flags.watchers,
    )


def _parser() -> Parser:
    parser = Parser("latency", __doc__)
    parser.add_argument("--model", type=Path, metavar="FILE", help="made by smal learn")
    parser.add_argument("--recordings", type=Path, metavar="DIR", help="drives to show; without model and recordings "
                        "both are made, which takes minutes")  # fmt: skip
    parser.add_argument("--camera", action="append", default=[], metavar="WIDTHxHEIGHT", help="size to which frames "
                        "are brought; may be repeated [default: their own, and 1024x768]")  # fmt: skip
    parser.add_argument("--ticks", type=int, metavar="N", help="frames for each camera")
    parser.add_argument("--watchers", type=int, metavar="N", default=0, help="pages that watch in every second drive")
    return parser
