"""``smal topic echo``, ``hz``, ``bw`` and ``latency``: listening to what crosses the bus."""

from __future__ import annotations

import json
import os
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Annotated, Final, cast

import typer
from typer import Argument, Option

from schemas.codec import DecodeError
from schemas.topics import APPLIED, COMMANDS, JPEG, OBSERVATION, POSE, ROOT, STATE
from services.cli import options
from services.cli.listening import arrivals
from services.cli.listening.arrivals import Arrivals
from services.cli.listening.latency import ACCEPTED, FRAME, LatencyTrace, rows
from services.cli.listening.samples import Sample
from services.kit.bus import Bus
from services.kit.errors import JobError
from services.kit.inbox import Inbox
from services.kit.tables import table

#: Samples kept while the terminal is slower than the bus.
QUEUE: Final = 64
CONNECT_S: Final = 2.0
Keys = Annotated[
    str | None,
    Argument(
        help="Key expression, or a topic's name such as camera/jpeg. [default: all of the robot]", metavar="[KEYEXPR]"
    ),
]
Seconds = Annotated[float, Option(min=0.1, max=3600, help="How long to listen; Ctrl-C ends it earlier.")]


def echo(
    *,
    keys: Keys = None,
    count: Annotated[int | None, Option(min=1, help="End after this many messages.")] = None,
    as_json: options.Json = False,
    reach: options.Reach,
) -> None:
    """Print every message until Ctrl-C.

    Each is one line, or with --json one JSON object; of binary data only the length is printed.

    Example: smal topic echo 'command/*' --json --count 5
    """
    inbox = Inbox()
    inbox.open("samples", QUEUE)
    with _listening(reach) as bus:
        bus.listen(
            key_expression(keys, reach.robot),
            lambda key, payload, encoding: inbox.put("samples", Sample(key, payload, encoding), len(payload)),
        )
        printed = 0
        while printed != count:
            item = inbox.take(None)
            if item is not None:
                sample = cast("Sample", item[1])
                say(json.dumps(sample.record()) if as_json else sample.line())
                printed += 1
    if inbox.dropped["samples"]:
        typer.echo(f"smal: {inbox.dropped['samples']} messages came faster than they were printed", err=True)


def hz(*, keys: Keys = None, seconds: Seconds = 5.0, as_json: options.Json = False, reach: options.Reach) -> None:
    """Measure rate and regularity of each key.

    The rate is that between the first message and the last, also where a robot drove only for a part of the time.

    Example: smal topic hz camera/jpeg --seconds 10
    """
    heard, _ = _hear(keys, seconds, reach)
    rates = {key: one.rates() for key, one in heard.items()}
    if as_json:
        say(json.dumps(rates, indent=2))
    elif rates:
        say("\n".join(arrivals.lines(rates, arrivals.RATES)))


def bw(*, keys: Keys = None, seconds: Seconds = 5.0, as_json: options.Json = False, reach: options.Reach) -> None:
    """Measure bandwidth and size of messages.

    Of each key, and in total. The bandwidth is that of the payloads over the whole time of listening. Listening to
    images costs their bandwidth once more.

    Example: smal topic bw 'camera/*' --seconds 10
    """
    heard, elapsed_s = _hear(keys, seconds, reach)
    sizes = {key: arrivals.sizes([one], elapsed_s) for key, one in heard.items()}
    total = arrivals.sizes(heard.values(), elapsed_s)
    if as_json:
        say(json.dumps({"seconds": elapsed_s, "keys": sizes, "total": total}, indent=2))
    elif sizes:
        say("\n".join(arrivals.lines(sizes | {"total": total}, arrivals.SIZES)))


def latency(
    *,
    seconds: Seconds = 10.0,
    camera: Annotated[bool, Option("--camera", help="Time camera/jpeg; for a robot without pose/truth.")] = False,
    as_json: options.Json = False,
    reach: options.Reach,
) -> None:
    """Break down the time from frame to command.

    Every hop is timed by the arrival of its messages here, on one clock. A frame begins with its pose/truth: the
    simulator sends it in the same instant, right before the image, and it is small. Listening to the images
    themselves (--camera) would have the router send every one of them once more, which slows down what is measured;
    and their arrival here would hide how long they travel.

    Beside it stands what the actuator measures on its own clock, from the frame's readiness to the acceptance of its
    command. In real time it tells what it does at the next frame, so "-> command/applied" is up to 100 ms there.

    Example: smal topic latency --seconds 30
    """
    frames = JPEG if camera else POSE
    trace = LatencyTrace(frames.name)
    bad: list[str] = []

    def take(key: str, payload: bytes, encoding: str) -> None:
        # On Zenoh's thread, where the time of arrival is true.
        now_s = time.monotonic()
        try:
            trace.see(Sample(key, payload, encoding).decoded(), now_s)
        except DecodeError:
            bad.append(key)

    with _listening(reach) as bus:
        for topic in (frames, OBSERVATION, STATE, *COMMANDS.values(), APPLIED):
            # Images in a session of their own, so that nothing else waits behind them; the rest in one, in order.
            bus.listen(topic.key(bus.robot), take, lane="ordinary" if topic is JPEG else "urgent")
        wait(f"frames ({frames.name}) and commands of {bus.robot}", seconds)
    if bad:
        typer.echo(f"smal: {len(bad)} messages could not be decoded; see smal topic echo", err=True)
    if not trace.drivers():
        came = f"{trace.commands} commands came, and {trace.frames} frames by {frames.name}; none was for the other"
        raise JobError(f"{came}; drive {reach.robot} meanwhile, and give --camera where it has no {POSE.name}")
    found = {driver: trace.breakdown(driver) for driver in trace.drivers()}
    if as_json:
        drivers = {
            driver: {"all": [{"from": start, "to": end} | spread for (start, end), spread in each.items()]}
            for driver, each in found.items()
        }
        told = {"robot": reach.robot, "frame": frames.name, "frames": trace.frames, "drivers": drivers}
        say(json.dumps(told, indent=2))
        return
    # A source that commands while a higher one drives is measured as well, up to its command.
    titles = {
        driver: driver if (FRAME, ACCEPTED) in each else f"{driver}, not obeyed" for driver, each in found.items()
    }
    say("\n".join(table([row for driver, each in found.items() for row in rows(titles[driver], each)])))


def key_expression(keys: str | None, robot: str) -> str:
    """Return a key expression as it is, or that of a topic's short name, or of everything, for one robot."""
    if keys is None:
        return f"{ROOT}/{robot}/**"
    return keys if keys == ROOT or keys.startswith((f"{ROOT}/", "*")) else f"{ROOT}/{robot}/{keys}"


def _hear(keys: str | None, seconds: float, reach: options.Reach) -> tuple[dict[str, Arrivals], float]:
    """Listen; return what came on each key, in their order, and for how many seconds it was listened."""
    expression = key_expression(keys, reach.robot)
    heard: defaultdict[str, Arrivals] = defaultdict(Arrivals)
    began_s = time.monotonic()
    with _listening(reach) as bus:
        # Noted on Zenoh's thread, where the time of arrival is true; one subscription, so one thread.
        bus.listen(expression, lambda key, payload, _: heard[key].add(len(payload), time.monotonic()))
        began_s = time.monotonic()
        wait(expression, seconds)
    if not heard:
        typer.echo(f"smal: nothing was published on {expression}", err=True)
    return dict(sorted(heard.items())), time.monotonic() - began_s


@contextmanager
def _listening(reach: options.Reach) -> Iterator[Bus]:
    """Connect to the bus; Ctrl-C, and a reader that closed the pipe, end the listening and nothing else."""
    with closing(reach.settings.open_bus("watcher", CONNECT_S)) as bus:
        try:
            yield bus
        except KeyboardInterrupt:
            pass
        except BrokenPipeError:
            # Python flushes standard output once more at exit; that must not fail again.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def wait(what: str, seconds: float) -> None:
    """Say what is listened to, and let the time pass."""
    typer.echo(f"listening to {what} for {seconds:g} s", err=True)
    time.sleep(seconds)


def say(text: str) -> None:
    """Print a line at once, also into a pipe."""
    typer.echo(text)
    sys.stdout.flush()
