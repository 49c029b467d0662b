"""The bus: time and processor time of a message from one process to another, ours over plain Zenoh.

Two processes are clients of a router of their own. All ways to send the same bytes take turns; a message is sent when
the one before has arrived. The time goes from before the sending to the decoded message (or the bytes) at the
receiver; a ratio is the median over turns of the median of our messages over that of plain Zenoh's in the same turn.

plain: an ordinary publisher, the bytes alone. same publisher: the one that the bus declares for the topic, the bytes
alone. callback: our message, decoded at once on the thread that received it. ours: our message, decoded and handled by
a node, as every service does. built: the same, and built from its raw parts before. Router and pipe cost all the same.
"""

from __future__ import annotations

import itertools
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from schemas import topics
from schemas.base import Message
from services.cli import certificates
from services.cli.bench import FOLDER
from services.cli.stack.child import tied
from services.cli.stack.processes import Stack, StackPlan, free_endpoint
from services.kit.settings import ServiceSettings
from services.table import givers
from tests.benchmarks.bus.flood import RATE_HZ
from tests.benchmarks.bus.messages import CASES, Case
from tests.benchmarks.bus.receiver import CALLBACK, NODE
from tests.benchmarks.bus.sender import Exchange, Senders, receiver
from tests.benchmarks.command_line import Parser, say
from tests.benchmarks.machine import machine
from tests.benchmarks.results import Record, table

#: What the target is about; the other ways tell where the time goes.
_JUDGED: Final = "ours"
#: What certificates may cost, by topic.
SECURE_LIMITS: Final = {
    topics.CAMERA.name: ("times the time", 1.5),
    topics.COMMANDS["policy"].name: ("ms more", 0.3),
}
FLOOD_LIMIT_MS: Final = 20.0
#: Of the robot's loop.
COMMAND_PERIOD_S: Final = 0.02
_FLOOD: Final = "import sys; sys.path.insert(0, sys.argv[1]); from tests.benchmarks.bus.flood import main; main()"


@dataclass(frozen=True)
class Plan:
    """How much is measured; the default is the full run.

    Parameters
    ----------
    turns : int
        Of all ways to send.
    messages : int
        Of each way in a turn, after one that is not counted.
    rate_hz : float
        Messages in a second, at most; 0 sends the next one at once.
    """

    turns: int = 300
    messages: int = 5
    rate_hz: float = 0.0


QUICK: Final = Plan(turns=40)


def benchmark(plan: Plan) -> dict[str, Any]:
    """Measure every message; return what the JSON file holds."""
    endpoint = free_endpoint()
    with (
        Stack(StackPlan(("router",), CALLBACK, endpoint)),
        receiver(endpoint) as wire,
        closing(Senders(endpoint)) as senders,
        tqdm(total=len(CASES) * plan.turns, desc="sending", unit="turn", dynamic_ncols=True) as bar,
    ):
        messages = [
            _measure(case, {way: partial(wire.exchange, send) for way, send in senders.of(case).items()}, plan, bar)
            for case in CASES
        ]
    results = {"benchmark": "bus", "machine": machine(), "plan": vars(plan), "messages": messages}
    return results | {"targets": [_judge(one) for one in messages]}


def benchmark_secure(plan: Plan) -> dict[str, Any]:
    """Measure what certificates and access rules cost: messages through a router without and one with them."""
    with (
        TemporaryDirectory() as folder,
        _node_and_receiver(None) as openly,
        _node_and_receiver(_keys(Path(folder))) as secured,
        tqdm(total=len(CASES) * plan.turns, desc="sending", unit="turn", dynamic_ncols=True) as bar,
    ):
        messages = [
            _measure(case, {"open": openly.exchange(case), "secure": secured.exchange(case)}, plan, bar)
            for case in CASES
        ]
    results = {"benchmark": "bus, secure", "machine": machine(), "plan": vars(plan), "messages": messages}
    return results | {"targets": [_judge_secure(one) for one in messages if one["topic"] in SECURE_LIMITS]}


def benchmark_flood(plan: Plan) -> dict[str, Any]:
    """Time commands, a message every 20 ms, while a watcher publishes some of its own that nobody may take."""
    case = next(case for case in CASES if case.topic is topics.COMMANDS["policy"])
    with (
        TemporaryDirectory() as folder,
        _node_and_receiver(keys := _keys(Path(folder))) as link,
        tqdm(total=2 * plan.turns, desc="sending", unit="turn", dynamic_ncols=True) as bar,
    ):
        quiet = _command_times_ms(link.exchange(case), plan, bar)
        with _flooding(link.endpoint, keys) as rates:
            flooded = _command_times_ms(link.exchange(case), plan, bar)
    rate = rates[-1]
    cost_ms = float(np.percentile(flooded, 95) - np.percentile(quiet, 95))
    rows = [
        {"commands": name, "median ms": float(np.median(some)), "p95 ms": float(np.percentile(some, 95))}
        for name, some in (("alone", quiet), (f"beside {rate} a second", flooded))
    ]
    target = {
        "target": f"p95 of a command beside a flood of {rate} a second, ms more",
        "measured": cost_ms,
        "limit": f"at most {FLOOD_LIMIT_MS:g}",
        "verdict": "met" if cost_ms <= FLOOD_LIMIT_MS and rate >= 0.99 * RATE_HZ else "not met",
    }
    return {"benchmark": "bus, flood", "machine": machine(), "commands": rows, "targets": [target]}


def _command_times_ms(exchange: Exchange, plan: Plan, bar: tqdm[Any]) -> NDArray[np.float64]:
    times = []
    for _ in range(plan.turns):
        for _ in range(plan.messages):
            time.sleep(COMMAND_PERIOD_S)
            times.append(exchange()[0] / 1e6)
        bar.update()
    return np.array(times)


@contextmanager
def _flooding(endpoint: str, keys: Path) -> Iterator[list[int]]:
    """Run the flood, which has begun when it has said how fast it is; gives what it has said, in the end all of it."""
    command = tied(sys.executable, "-P", "-c", _FLOOD, str(FOLDER.parents[1]), endpoint, str(keys))
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        rates = [int(process.stdout.readline())]
        try:
            yield rates
        finally:
            process.kill()
            rates += map(int, process.stdout.read().split())


def _keys(folder: Path) -> Path:
    certificates.begin(folder, NODE)
    certificates.issue(folder, certificates.HOSTS)
    return folder


class _Link(NamedTuple):
    """A router with both ends: how a case is sent by the role that sends it in a stack."""

    endpoint: str
    exchange: Callable[[Case], Exchange]


@contextmanager
def _node_and_receiver(keys: Path | None) -> Iterator[_Link]:
    """Run a router and both ends."""
    endpoint = free_endpoint() if keys is None else free_endpoint().replace("tcp/", "tls/")
    settings = ServiceSettings(robot=NODE, router=endpoint, secure=keys)
    with (
        Stack(StackPlan(("router",), NODE, endpoint, secure=keys)),
        receiver(endpoint, keys) as wire,
        ExitStack() as stack,
    ):

        def exchange(case: Case) -> Exchange:
            bus = stack.enter_context(closing(settings.open_bus(givers(case.topic)[0])))
            message = case.build(Message(robot=NODE, episode="e", tick=7, stamp_ns=time.time_ns()))
            return partial(wire.exchange, partial(bus.publish, message))

        yield _Link(endpoint, exchange)


def _judge_secure(one: dict[str, Any]) -> Record:
    open_us, secure_us = (one["ways"][way]["median_us"] for way in ("open", "secure"))
    kind, limit = SECURE_LIMITS[one["topic"]]
    measured = (secure_us - open_us) / 1e3 if kind == "ms more" else secure_us / open_us
    return {
        "target": f"{one['message']}, with certificates",
        "measured": measured,
        "limit": f"at most {limit:g} {kind}",
        "verdict": "met" if measured <= limit else "not met",
    }


def _measure(case: Case, ways: Mapping[str, Exchange], plan: Plan, bar: tqdm[Any]) -> dict[str, Any]:
    """Let all ways take turns, each turn in another order."""
    bar.set_postfix_str(case.name)
    times = np.zeros((plan.turns, len(ways), plan.messages, 2))
    orders = itertools.cycle(np.random.default_rng(1).permuted(np.tile(np.arange(len(ways)), (50, 1)), axis=1))
    exchanges = list(ways.values())
    for turn, order in zip(range(plan.turns), orders, strict=False):
        for way in order:
            times[turn, way] = _burst(exchanges[way], plan)
        bar.update()
    figures = {name: _figures(times[:, k], times[:, 0]) for k, name in enumerate(ways)}
    return {"message": case.name, "topic": case.topic.name, "limit": case.limit, "ways": figures}


def _burst(exchange: Exchange, plan: Plan) -> NDArray[np.float64]:
    """Send some messages one after the other; the first pays for what came before."""
    times = []
    for _ in range(plan.messages + 1):
        if plan.rate_hz:
            time.sleep(1.0 / plan.rate_hz)
        times.append(exchange())
    return np.array(times[1:], dtype=np.float64)


def _figures(ours: NDArray[np.float64], plain: NDArray[np.float64]) -> Record:
    """Summarize times (turns, messages, 2) of which the last axis is one way and processor, nanoseconds."""
    one_way, worked = np.moveaxis(ours, -1, 0) / 1e3
    by_turn = np.median(ours, axis=1) / np.median(plain, axis=1)
    ratio, processor_ratio = np.median(by_turn, axis=0)
    return {
        "median_us": float(np.median(one_way)),
        "p95_us": float(np.percentile(one_way, 95)),
        "processor_us": float(np.mean(worked)),
        "ratio": float(ratio),
        "ratio_of_medians": float(np.median(ours[..., 0]) / np.median(plain[..., 0])),
        "processor_ratio": float(processor_ratio),
    }


def _judge(one: dict[str, Any]) -> Record:
    """Compare with what we set out to reach."""
    ratio = one["ways"][_JUDGED]["ratio"]
    return {
        "target": f"{one['message']}, {_JUDGED} over plain",
        "measured": ratio,
        "limit": f"at most {one['limit']:g}",
        "verdict": "met" if ratio <= one["limit"] else "not met",
    }


def as_text(results: dict[str, Any]) -> str:
    """Write the tables."""
    if "commands" in results:
        return table("Commands, milliseconds", results["commands"]) + table("Targets", results["targets"])
    rows = [
        {"message": one["message"], "way": way, "median us": f["median_us"], "p95 us": f["p95_us"],
         "ratio": f["ratio"], "ratio of medians": f["ratio_of_medians"], "processor us": f["processor_us"],
         "processor ratio": f["processor_ratio"]}
        for one in results["messages"] for way, f in one["ways"].items()
    ]  # fmt: skip
    return table("One message from process to process, microseconds", rows) + table("Targets", results["targets"])


def main(arguments: list[str]) -> None:
    """Read the flags, measure, print and write."""
    parser = Parser("bus", __doc__)
    parser.add_argument("--rate", type=float, default=0.0, metavar="HZ", help="messages in a second, at most")
    parser.add_argument("--secure", action="store_true", help="measure what certificates cost, in place of the rest")
    parser.add_argument("--flood", action="store_true", help="measure commands beside a flood, in place of the rest")
    flags = parser.parse(arguments)
    shape = QUICK if flags.quick else Plan()
    measure = benchmark_secure if flags.secure else benchmark_flood if flags.flood else benchmark
    results = measure(Plan(shape.turns, shape.messages, flags.rate))
    say(flags, results, as_text(results))
