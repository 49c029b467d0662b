"""Decision latency: from the capture of the last frame to the command at the actuator, in real time.

The services features, recognition and policy run as processes on a router of their own. In place of the simulator a
recorded drive is shown to them at 10 Hz, and what the policy answers goes through the actuator's gate. The time goes
from before a frame is packed to the acceptance of its command; rendering is apart. The filter decides at every frame;
the paper's scheme every l frames, and follows its plan at the others.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, get_args

from tqdm import tqdm

from schemas.rpc import LoadReply, LoadRequest, Scheme
from services.cli.options import Camera, read_model
from services.cli.stack.processes import Stack, StackPlan, flags, free_endpoint
from services.kit.errors import UsageError
from services.kit.settings import ServiceSettings
from services.recordings.dataset import find_recordings
from tests.benchmarks.command_line import Parser, say
from tests.benchmarks.latency.drives import drives, make, resized
from tests.benchmarks.latency.load import Load, processes_of
from tests.benchmarks.latency.results import as_text, figures_of, judge
from tests.benchmarks.latency.robot import Answers, Robot
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
    """

    ticks: int = 1000
    schemes: Sequence[Scheme] = ("filter", "paper")
    cameras: Sequence[Camera | None] = (None, Camera(1024, 768))
    episodes: int = 12
    recoveries: int = 60
    stages: bool = False


def benchmark(plan: Plan, model: Path, recordings: Path, logs: Path) -> dict[str, Any]:
    """Measure every case; return what the JSON file holds."""
    endpoint, below = free_endpoint(), flags(root=model.resolve().parent)
    total = plan.ticks * len(plan.schemes) * len(plan.cameras)
    with (
        Stack(
            StackPlan(SERVICES, _ROBOT, endpoint, dict.fromkeys(("recognition", "policy"), below), logs=logs)
        ) as stack,
        closing(Robot(ServiceSettings(robot=_ROBOT, router=endpoint), stages=plan.stages)) as robot,
        tqdm(total=total, desc="driving", unit="frame", dynamic_ncols=True) as bar,
    ):
        cases = []
        for scheme in plan.schemes:
            loaded = _load(robot, model, scheme)
            for camera in plan.cameras:
                stack.check()
                cases.append(_measure(robot, loaded, recordings, camera, plan.ticks, bar))
    results = {"benchmark": "latency", "machine": machine(), "ticks": plan.ticks, "cases": cases}
    return results | {"targets": [judge(one) for one in cases]}


def _load(robot: Robot, model: Path, scheme: Scheme) -> LoadReply:
    """Have recognition and policy load the model; return what both have loaded."""
    request, bus = LoadRequest(model=model.resolve().name, scheme=scheme), robot.node.bus
    bus.call("policy", "load", request, LoadReply, timeout_s=_LOADING_S)
    return bus.call("recognition", "load", request, LoadReply, timeout_s=_LOADING_S)


def _measure(
    robot: Robot, loaded: LoadReply, recordings: Path, camera: Camera | None, ticks: int, bar: tqdm[Any]
) -> dict[str, Any]:
    """Show drives until there are enough frames."""
    answers: list[Answers] = []
    size = ""
    load = Load(processes_of(robot.node.bus, SERVICES))
    for k, (recorded, way) in enumerate(drives(recordings)):
        left = ticks - sum(one.ticks for one in answers)
        if left <= 0:
            break
        frames = resized(recorded[:left], camera)
        height, width, _ = frames[0].shape
        size = f"{width}x{height}"
        bar.set_postfix_str(f"{loaded.scheme}, {size}")
        with load.watched():
            answers.append(robot.drive(f"bench-{loaded.scheme}-{width}-{k}", frames, way[:left], bar.update))
    facts = {"camera": size} | loaded.model_dump(include={"scheme", "keyframes", "templates", "states", "stride"})
    return facts | figures_of(answers, loaded) | {"cores": load.cores()}


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
    parser.add_argument("--stages", action="store_true", help="tell how long each service takes")
    return parser
