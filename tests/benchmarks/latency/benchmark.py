"""Decision latency: from the capture of the last frame to the command at the actuator, in real time.

The services features, recognition and policy run as processes on a router of their own. In place of the simulator a
recorded drive is shown to them at 10 Hz, and what the policy answers goes through the actuator's gate. The time goes
from before a frame is packed to the acceptance of its command; rendering is apart. The filter decides at every frame;
the paper's scheme every l frames, and follows its plan at the others. With --watchers every case is measured twice, in
turns drive by drive: with no page of the console, and with so many that watch, the first of which takes nothing.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, get_args

from tqdm import tqdm

from schemas.rpc import LoadReply, LoadRequest, Scheme
from services.cli.options import Camera, read_model
from services.cli.stack.processes import Stack, StackPlan, flags, free_endpoint
from services.kit.errors import UsageError
from services.kit.jpeg import encode_jpeg
from services.kit.settings import ServiceSettings
from services.recordings.dataset import find_recordings
from tests.benchmarks.command_line import Parser, say
from tests.benchmarks.latency.drives import Frames, Way, drives, make, resized
from tests.benchmarks.latency.load import Load, processes_of
from tests.benchmarks.latency.results import as_text, figures_of, judge, judge_watched
from tests.benchmarks.latency.robot import Answers, Robot
from tests.benchmarks.latency.watchers import watching
from tests.benchmarks.machine import machine

SERVICES: Final = ("router", "features", "recognition", "policy")
_ROBOT: Final = "bench"
_LOADING_S: Final = 120.0


@dataclass(frozen=True)
class Plan:
    """What is measured; the default is the full run.

    Parameters
    ----------
    ticks : int
        Frames for each case.
    schemes : sequence of str
        How recognition and policy work.
    cameras : sequence of Camera or None
        Sizes of the image; None is that of the recordings.
    episodes, recoveries : int
        Drives to make where no model is given.
    stages : bool
        Whether to tell how long each service takes.
    watchers : int
        Pages that watch in every second drive; 0 for no console at all.
    """

    ticks: int = 1000
    schemes: Sequence[Scheme] = ("filter", "paper")
    cameras: Sequence[Camera | None] = (None, Camera(1024, 768))
    episodes: int = 12
    recoveries: int = 60
    stages: bool = False
    watchers: int = 0


def benchmark(plan: Plan, model: Path, recordings: Path, logs: Path) -> dict[str, Any]:
    """Measure every case; return what the JSON file holds."""
    endpoint, below = free_endpoint(), flags(root=model.resolve().parent)
    page = free_endpoint().removeprefix("tcp/") if plan.watchers else ""
    services = (*SERVICES, "console") if page else SERVICES
    own = {**dict.fromkeys(("recognition", "policy"), below), "console": (*below, *flags(console=page))}
    counts = [0, plan.watchers] if page else [0]
    total = plan.ticks * len(plan.schemes) * len(plan.cameras) * len(counts)
    with (
        Stack(StackPlan(services, _ROBOT, endpoint, own, logs=logs)) as stack,
        closing(Robot(ServiceSettings(robot=_ROBOT, router=endpoint), stages=plan.stages)) as robot,
        tqdm(total=total, desc="driving", unit="frame", dynamic_ncols=True) as bar,
    ):
        cases = []
        for scheme in plan.schemes:
            loaded = _load(robot, model, scheme)
            for camera in plan.cameras:
                stack.check()
                bar.set_postfix_str(f"{scheme}, {camera or 'as recorded'}")
                shown = _shown(recordings, camera, plan.ticks)
                sides = [Side(count, Load(processes_of(robot.node.bus, services))) for count in counts]
                for k, (frames, way) in enumerate(shown):
                    for side in sides:
                        side.measure(robot, f"bench-{scheme}-{len(cases)}-{k}-{side.watchers}", frames, way, page, bar)
                cases += [side.case(loaded) for side in sides]
    results = {"benchmark": "latency", "machine": machine(), "ticks": plan.ticks, "cases": cases}
    ratios = [judge_watched(*pair) for pair in zip(cases[::2], cases[1::2], strict=True)] if page else []
    return results | {"targets": [judge(one) for one in cases] + ratios}


def _load(robot: Robot, model: Path, scheme: Scheme) -> LoadReply:
    """Have recognition and policy load the model; return what both have loaded."""
    request, bus = LoadRequest(model=model.resolve().name, scheme=scheme), robot.node.bus
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
    load: Load
    answers: list[Answers] = field(default_factory=list)
    camera: str = ""

    def measure(self, robot: Robot, episode: str, frames: Frames, way: Way, page: str, bar: tqdm[Any]) -> None:
        """Show one drive."""
        height, width, _ = frames[0].shape
        self.camera = f"{width}x{height}"
        # Made before: who drives is not kept by it.
        pictures = [encode_jpeg(one) for one in frames] if page else None
        watched = watching(page, self.watchers) if self.watchers else nullcontext()
        with watched, self.load.watched():
            self.answers.append(robot.drive(episode, frames, way, bar.update, pictures))

    def case(self, loaded: LoadReply) -> dict[str, Any]:
        """Return the figures."""
        facts = loaded.model_dump(include={"scheme", "keyframes", "templates", "states", "stride"})
        found = figures_of(self.answers, loaded) | {"cores": self.load.cores()}
        return {"camera": self.camera, "watchers": self.watchers} | facts | found


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
        _check(model, recordings, plan)
        results = benchmark(plan, model, recordings, folder / "logs")
    say(flags, results, as_text(results))


def _plan(flags: argparse.Namespace) -> Plan:
    shape = Plan(ticks=100, episodes=2, recoveries=2) if flags.quick else Plan()
    return Plan(
        flags.ticks or shape.ticks,
        flags.scheme or shape.schemes,
        [Camera.parse(size) for size in flags.camera] or shape.cameras,
        shape.episodes,
        shape.recoveries,
        flags.stages,
        flags.watchers,
    )


def _check(model: Path, recordings: Path, plan: Plan) -> None:
    """Find out what is wrong with the files before services start."""
    for scheme in plan.schemes:
        read_model(model, scheme, None)
    find_recordings([recordings])


def _parser() -> Parser:
    parser = Parser("latency", __doc__)
    parser.add_argument("--model", type=Path, metavar="FILE", help="made by smal learn")
    parser.add_argument("--recordings", type=Path, metavar="DIR", help="drives to show; without model and recordings "
                        "both are made, which takes minutes")  # fmt: skip
    parser.add_argument("--scheme", action="append", choices=get_args(Scheme), help="how recognition and policy work; "
                        "may be repeated [default: both]")  # fmt: skip
    parser.add_argument("--camera", action="append", default=[], metavar="WIDTHxHEIGHT", help="size to which frames "
                        "are brought; may be repeated [default: their own, and 1024x768]")  # fmt: skip
    parser.add_argument("--ticks", type=int, metavar="N", help="frames for each scheme and camera")
    parser.add_argument("--watchers", type=int, metavar="N", default=0, help="pages that watch in every second drive")
    parser.add_argument("--stages", action="store_true", help="tell how long each service takes")
    return parser
