"""The bus: time and processor time of a message from one process to another, ours over plain Zenoh.

Two processes are clients of a router of their own. All ways to send the same bytes take turns; a message is sent when
the one before has arrived. The time goes from before the sending to the decoded message (or the bytes) at the
receiver; a ratio is the median over turns of the median of our messages over that of plain Zenoh's in the same turn.

plain: an ordinary publisher, the bytes alone. same publisher: the one that the bus declares for the topic, the bytes
alone. callback: our message, decoded at once on the thread that received it. ours: our message, decoded and handled by
a node, as every service does. built: the same, and built from its raw parts before. Router and pipe cost all the same.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from services.cli.stack.processes import Stack, StackPlan, free_endpoint
from tests.benchmarks.bus.messages import CASES, Case
from tests.benchmarks.bus.receiver import CALLBACK
from tests.benchmarks.bus.sender import Send, Senders, Wire, receiver
from tests.benchmarks.command_line import Parser
from tests.benchmarks.machine import machine
from tests.benchmarks.results import Record, table, write_json

#: What the target is about; the other ways tell where the time goes.
_JUDGED: Final = "ours"


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
        messages = [_measure(case, senders.of(case), wire, plan, bar) for case in CASES]
    results = {"benchmark": "bus", "machine": machine(), "plan": vars(plan), "messages": messages}
    return results | {"targets": [_judge(one) for one in messages]}


def _measure(case: Case, ways: Mapping[str, Send], wire: Wire, plan: Plan, bar: tqdm[Any]) -> dict[str, Any]:
    """Let all ways take turns, each turn in another order."""
    bar.set_postfix_str(case.name)
    times = np.zeros((plan.turns, len(ways), plan.messages, 2))
    orders = itertools.cycle(np.random.default_rng(1).permuted(np.tile(np.arange(len(ways)), (50, 1)), axis=1))
    sends = list(ways.values())
    for turn, order in zip(range(plan.turns), orders, strict=False):
        for way in order:
            times[turn, way] = _burst(wire, sends[way], plan)
        bar.update()
    figures = {name: _figures(times[:, k], times[:, 0]) for k, name in enumerate(ways)}
    return {"message": case.name, "topic": case.topic.name, "limit": case.limit, "ways": figures}


def _burst(wire: Wire, send: Send, plan: Plan) -> NDArray[np.float64]:
    """Send some messages one after the other; the first pays for what came before."""
    times = []
    for _ in range(plan.messages + 1):
        if plan.rate_hz:
            time.sleep(1.0 / plan.rate_hz)
        times.append(wire.exchange(send))
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
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--rate", type=float, default=0.0, metavar="HZ", help="messages in a second, at most")
    flags = parser.parse(arguments)
    shape = QUICK if flags.quick else Plan()
    results = benchmark(Plan(shape.turns, shape.messages, flags.rate))
    if flags.json is not None:
        write_json(flags.json, {"quick": flags.quick, **results})
    sys.stdout.write(as_text(results))
    if flags.json is not None:
        sys.stdout.write(f"\nresults: {flags.json}\n")
