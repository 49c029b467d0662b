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
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from schemas.rpc import LoadReply, LoadRequest
from services.cli.options import Camera, read_model
from services.cli.stack.processes import Stack, StackPlan, flags, free_endpoint
from services.kit.errors import JobError, UsageError
from services.kit.settings import ServiceSettings
from services.recordings.dataset import find_recordings
from services.recordings.encoding import decode_image
from services.recordings.reader import RecordingError, read_recording
from tests.benchmarks.child import child
from tests.benchmarks.drives import taught
from tests.benchmarks.latency.robot import Robot, Way
from tests.benchmarks.latency.watchers import watch
from tests.benchmarks.reporting import Parser, Record, say, table

SERVICES: Final = ("router", "features", "recognition", "policy")
_ROBOT: Final = "bench"
_LOADING_S: Final = 120.0
Frames = list[NDArray[np.uint8]]


@dataclass(frozen=True)
class Plan:
    """What is measured: frames for each camera (None is that of the recordings), drives to make, pages that watch."""

    ticks: int = 1000
    cameras: Sequence[Camera | None] = (None, Camera(1024, 768))
    episodes: int = 12
    recoveries: int = 60
    watchers: int = 0


def benchmark(plan: Plan, model: Path, recordings: Path, logs: Path) -> dict[str, Any]:
    """Measure every case; return what the JSON file holds."""
    endpoint, below = free_endpoint(), flags(root=model.resolve().parent)
    page = free_endpoint().removeprefix("tcp/")
    services = (*SERVICES, "console") if plan.watchers else SERVICES
    own = {**dict.fromkeys(("recognition", "policy"), below), "console": (*below, *flags(console=page))}
    counts = (0, plan.watchers) if plan.watchers else (0,)
    taken_s: defaultdict[tuple[str, int], list[float | None]] = defaultdict(list)
    with (
        Stack(StackPlan(services, _ROBOT, endpoint, own, logs=logs)) as stack,
        closing(Robot(ServiceSettings(robot=_ROBOT, router=endpoint))) as robot,
        tqdm(total=plan.ticks * len(plan.cameras) * len(counts), desc="driving", unit="frame") as bar,
    ):
        # Both load the same model.
        request = LoadRequest(model=model.resolve().name)
        loaded = [
            robot.node.bus.call(name, "load", request, LoadReply, _LOADING_S) for name in ("policy", "recognition")
        ]
        for camera in plan.cameras:
            stack.check()
            for k, (frames, way) in enumerate(_shown(recordings, camera, plan.ticks)):
                height, width, _ = frames[0].shape
                for count in counts:
                    with child("the pages", watch, page, count) if count else nullcontext():
                        case = taken_s[f"{width}x{height}", count]
                        case += robot.drive(f"bench-{len(taken_s)}-{k}-{count}", frames, way, bar.update)
    cases = [
        {"camera": camera, "watchers": count, "keyframes": loaded[0].keyframes} | summary(taken)
        for (camera, count), taken in taken_s.items()
    ]
    return {"benchmark": "latency", "ticks": plan.ticks, "cases": cases}


def summary(taken_s: Sequence[float | None]) -> Record:
    """Give percentiles in milliseconds; a frame without a command took for ever, which is told as None."""
    taken = np.array([np.inf if one is None else 1e3 * one for one in taken_s] or [np.inf])
    marks = {f"p{mark}_ms": float(np.percentile(taken, mark, method="higher")) for mark in (50, 95)}
    known: Record = {name: value if np.isfinite(value) else None for name, value in marks.items()}
    return {"frames": len(taken_s), "missing": sum(one is None for one in taken_s)} | known


def _shown(recordings: Path, camera: Camera | None, ticks: int) -> Iterator[tuple[Frames, Way]]:
    """Give drives, over and over, until there are enough frames of the camera's size."""
    for frames, way in drives(recordings):
        if ticks <= 0:
            return
        size = None if camera is None else (camera.width, camera.height)
        shown = frames[:ticks]
        if size is not None and frames[0].shape[1::-1] != size:
            shown = [np.asarray(cv2.resize(one, size, interpolation=cv2.INTER_CUBIC), np.uint8) for one in shown]
        yield shown, way[:ticks]
        ticks -= len(frames)


def drives(folder: Path) -> Iterator[tuple[Frames, Way]]:
    """Give the camera images of one whole drive after the other, (height, width, 3), and its way, over and over.

    Raises
    ------
    JobError
        There is none.
    """
    found = True
    while found:
        found = False
        for path in find_recordings([folder]):
            try:
                episodes = read_recording(path).episodes
            except RecordingError as error:
                raise JobError(str(error)) from None
            for episode in episodes:
                ticks = sorted(episode.images.keys() & episode.odometry.keys())
                if episode.purpose != "recovery" and ticks:
                    found = True
                    images = [decode_image(bytes(episode.images[tick])) for tick in ticks]
                    yield images, [episode.wheels(tick) for tick in ticks]
    raise JobError(f"{folder}: holds no drive with camera images and odometry")


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
            model, recordings = taught(folder, plan.episodes, plan.recoveries, "campus", "320x240"), folder
        # What is wrong with the files is found out before services start.
        read_model(model, "filter", None)
        find_recordings([recordings])
        results = benchmark(plan, model, recordings, folder / "logs")
    say(flags, results, table("From the capture of a frame to its command", results["cases"]))


def _plan(flags: argparse.Namespace) -> Plan:
    shape = Plan(ticks=100, episodes=2, recoveries=2) if flags.quick else Plan()
    cameras = [Camera.parse(size) for size in flags.camera] or shape.cameras
    return Plan(flags.ticks or shape.ticks, cameras, shape.episodes, shape.recoveries, flags.watchers)


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
