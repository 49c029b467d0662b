"""The bus: time of a message from one process to another, ours over plain Zenoh.

Two processes are clients of a router of their own. A message is sent when the one before has arrived, and all ways to
send it take turns. The time goes from before the sending to the message that a node hands to its service (ours), or to
the same bytes (plain). A ratio is the median over turns of the median within a turn.

--secure: what certificates cost, in place of that. --flood: what a watcher's 10,000 messages a second cost commands.
"""

import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from schemas import topics
from schemas.array import Float32Array
from schemas.base import Message
from schemas.camera import CompressedImage
from schemas.codec import encode
from schemas.command import Command
from schemas.observation import Observation
from schemas.topics import Topic
from services.cli.stack import Stack, StackPlan, free_endpoint
from services.kit.errors import JobError
from services.kit.jpeg import encode_jpeg
from services.kit.settings import ServiceSettings
from services.table import givers
from smal.features import FeatureSettings
from tests.benchmarks.bus.peers import RATE_HZ, flood, plain_beside, receive
from tests.benchmarks.child import Child, child
from tests.benchmarks.reporting import Parser, Record, say, table, verdict
from tests.schemas.messages import EXAMPLES
from tests.services.secured import ROBOT, make_keys

#: How much longer than plain Zenoh a message may take.
FRAME_LIMIT = 1.3
SMALL_LIMIT = 3.0
#: What certificates may cost: a frame times as long, a command milliseconds more; and a flood, milliseconds.
SECURE_FRAME_LIMIT = 1.5
SECURE_COMMAND_MS = 0.3
FLOOD_MS = 20.0
COMMAND_PERIOD_S: Final = 0.02  # Period of the robot's loop.
_SIZE: Final = (768, 1024, 3)
_PATIENCE_S: Final = 5.0  # A message of a busy machine takes less; what takes longer is lost.
COMMAND: Final = topics.COMMANDS["policy"]
TOPICS: Final = (topics.JPEG, topics.OBSERVATION, topics.STATE, COMMAND, topics.APPLIED)


@dataclass(frozen=True)
class Plan:
    """How much is measured: turns of all ways, messages of each way in a turn, and how many a second at most."""

    turns: int = 300
    messages: int = 5
    rate_hz: float = 0.0


QUICK: Final = Plan(turns=40)


def message_of(topic: Topic) -> Message:
    """Return a message as it is sent in a run: a frame of 1024x768, the usual features."""
    rng = np.random.default_rng(1)
    example = EXAMPLES[topic.message].model_copy(update={"robot": ROBOT})
    if topic is topics.JPEG:
        pixels = rng.integers(0, 256, _SIZE, dtype=np.uint8)
        return CompressedImage.after(
            example, width=_SIZE[1], height=_SIZE[0], data=encode_jpeg(pixels)
        )
    if topic is topics.OBSERVATION:
        features = rng.standard_normal(FeatureSettings().size, dtype=np.float32)
        return Observation.after(
            example, fingerprint="0123456789abcdef", features=Float32Array.from_numpy(features)
        )
    return Command.after(example, source="policy", atom="forward") if topic is COMMAND else example


class Link:
    """A router with both ends."""

    def __init__(self, endpoint: str, keys: Path | None, receiver: Child, stack: ExitStack) -> None:
        self.endpoint = endpoint
        self._receiver = receiver
        settings = ServiceSettings(robot=ROBOT, router=endpoint, secure=keys)
        self._buses = {
            topic: stack.enter_context(closing(settings.open_bus(givers(topic)[0])))
            for topic in TOPICS
        }

    def times_us(self, topic: Topic, plan: Plan, *, plain: bool = False) -> NDArray[np.float64]:
        """Send a message some times, after one that is not counted; return how long each took to arrive."""
        bus = self._buses[topic]
        message = message_of(topic)
        payload = encode(message)
        publisher = (
            bus.declare_publisher(replace(plain_beside(topic), recorded=False)) if plain else None
        )
        times = []
        for _ in range(plan.messages + 1):
            if plan.rate_hz:
                time.sleep(1.0 / plan.rate_hz)
            began_ns = time.monotonic_ns()
            if publisher is None:
                bus.publish(message)
            else:
                publisher.put(payload)
            if not self._receiver.pipe.poll(_PATIENCE_S):
                raise JobError(
                    "a message of the benchmark did not arrive; is the machine too busy?"
                )
            times.append((self._receiver.pipe.recv() - began_ns) / 1e3)
        return np.array(times[1:])


@contextmanager
def linked(keys: Path | None = None) -> Iterator[Link]:
    """Run a router, and a process that receives."""
    endpoint = (
        free_endpoint()
        if keys is None
        else free_endpoint().replace("tcp/127.0.0.1", "tls/localhost")
    )
    with (
        Stack(StackPlan(("router",), ROBOT, endpoint, secure=keys)),
        child("the receiver", receive, endpoint, keys, TOPICS) as receiver,
        ExitStack() as stack,
    ):
        yield Link(endpoint, keys, receiver, stack)


def benchmark(plan: Plan) -> dict[str, Any]:
    """Measure every message, plain and ours."""
    with linked() as link:
        rows = _compare({"plain": (link, True), "ours": (link, False)}, TOPICS, plan)
    limits = {topic.name: FRAME_LIMIT if topic is topics.JPEG else SMALL_LIMIT for topic in TOPICS}
    judged = [verdict(f"{one['topic']}, ours over plain", one["ratio"], limits[one["topic"]])
              for one in rows if one["way"] == "ours"]  # fmt: skip
    return {"benchmark": "bus", "messages": rows, "targets": judged}


def benchmark_secure(plan: Plan) -> dict[str, Any]:
    """Measure what certificates and access rules cost, frames and commands."""
    with (
        TemporaryDirectory() as folder,
        linked() as openly,
        linked(make_keys(Path(folder))) as secured,
    ):
        ways = {"open": (openly, False), "secure": (secured, False)}
        rows = _compare(ways, (topics.JPEG, COMMAND), plan)
    frame = rows[1]
    (openly_us, secure_us) = (one["median_us"] for one in rows[2:])
    judged = [
        verdict("frame with certificates", frame["ratio"], SECURE_FRAME_LIMIT, " times as long"),
        verdict(
            "command with certificates",
            (secure_us - openly_us) / 1e3,
            SECURE_COMMAND_MS,
            " ms more",
        ),
    ]
    return {"benchmark": "bus, secure", "messages": rows, "targets": judged}


def benchmark_flood(plan: Plan) -> dict[str, Any]:
    """Time commands, one every 20 ms, while a watcher publishes commands, which it may not."""
    plan = replace(plan, messages=plan.turns * plan.messages, rate_hz=1.0 / COMMAND_PERIOD_S)
    with TemporaryDirectory() as folder, linked(keys := make_keys(Path(folder))) as link:
        quiet = link.times_us(COMMAND, plan)
        with child("the flood", flood, link.endpoint, keys, COMMAND.key(ROBOT)) as flooder:
            flooded = link.times_us(COMMAND, plan)
            rates = [flooder.said]
            while flooder.pipe.poll():
                rates.append(flooder.pipe.recv())
    rows = [
        _row(COMMAND, name, times, quiet[None])
        for name, times in (("alone", quiet[None]), ("flooded", flooded[None]))
    ]
    cost_ms = (rows[1]["p95_us"] - rows[0]["p95_us"]) / 1e3
    judged = verdict(
        f"p95 of a command beside {rates[-1]:.0f} a second", cost_ms, FLOOD_MS, " ms more"
    )
    if rates[-1] < 0.99 * RATE_HZ:
        judged["verdict"] = "not met"
    return {"benchmark": "bus, flood", "messages": rows, "flood_hz": rates[-1], "targets": [judged]}


def _compare(
    ways: dict[str, tuple[Link, bool]], sent: Sequence[Topic], plan: Plan
) -> list[dict[str, Any]]:
    """Let all ways take turns; ratios are over the first."""
    rows = []
    for topic in sent:
        turns = tqdm(range(plan.turns), desc=topic.name, unit="turn", dynamic_ncols=True)
        times = np.array(
            [
                [link.times_us(topic, plan, plain=plain) for link, plain in ways.values()]
                for _ in turns
            ]
        )
        rows += [_row(topic, way, times[:, k], times[:, 0]) for k, way in enumerate(ways)]
    return rows


def _row(topic: Topic, way: str, times: NDArray[np.float64], first: NDArray[np.float64]) -> Record:
    return {
        "topic": topic.name,
        "way": way,
        "median_us": float(np.median(times)),
        "p95_us": float(np.percentile(times, 95)),
        "ratio": float(np.median(np.median(times, axis=1) / np.median(first, axis=1))),
    }


def main(arguments: list[str]) -> None:
    """Read the flags, measure, print and write."""
    parser = Parser("bus", __doc__)
    parser.add_argument(
        "--rate", type=float, default=0.0, metavar="HZ", help="messages in a second, at most"
    )
    parser.add_argument(
        "--secure", action="store_true", help="measure what certificates cost, in place of the rest"
    )
    parser.add_argument(
        "--flood", action="store_true", help="measure commands beside a flood, in place of the rest"
    )
    flags = parser.parse(arguments)
    plan = replace(QUICK if flags.quick else Plan(), rate_hz=flags.rate)
    results = (benchmark_secure if flags.secure else benchmark_flood if flags.flood else benchmark)(
        plan
    )
    say(
        flags,
        results,
        table("From process to process", results["messages"])
        + table("Targets", results["targets"]),
    )
