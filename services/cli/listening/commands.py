"""``smal topic echo``, ``hz`` and ``bw``: listening to key expressions, and what the others need to listen too."""

from __future__ import annotations

import json
import os
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Annotated, Final, cast

import typer

from schemas.topics import ROOT
from services.cli.listening.bandwidth import Sizes, bandwidth_lines, total
from services.cli.listening.rates import Rate, rate_lines
from services.cli.listening.samples import Sample
from services.cli.options import DEFAULT_ROBOT, Json, Robot, Router, Secure, settings_for
from services.kit.bus import Bus
from services.kit.inbox import Inbox

#: Samples kept while the terminal is slower than the bus; a raw frame takes 2.4 MB.
QUEUE: Final = 64
CONNECT_S: Final = 2.0
Keys = Annotated[
    str | None,
    typer.Argument(
        help="Key expression, or a topic's name such as camera/rgb. [default: all of the robot]", metavar="[KEYEXPR]"
    ),
]
Seconds = Annotated[float, typer.Option(min=0.1, max=86400, help="How long to listen; Ctrl-C ends it earlier.")]


def echo(
    keys: Keys = None,
    count: Annotated[int | None, typer.Option(min=1, help="End after this many messages.")] = None,
    as_json: Json = False,
    robot: Robot = DEFAULT_ROBOT,
    router: Router = None,
    secure: Secure = None,
) -> None:
    """Print every message until Ctrl-C.

    Each is one line, or with --json one JSON object; of binary data only the length is printed.

    Example: smal topic echo 'command/*' --json --count 5
    """
    inbox = Inbox()
    inbox.open("samples", QUEUE)
    with listening(robot, router, secure) as bus:
        bus.listen(
            key_expression(keys, robot),
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


def hz(
    keys: Keys = None,
    seconds: Seconds = 5.0,
    as_json: Json = False,
    robot: Robot = DEFAULT_ROBOT,
    router: Router = None,
    secure: Secure = None,
) -> None:
    """Measure rate and regularity of each key.

    The rate is that between the first message and the last, also where a robot drove only for a part of the time.

    Example: smal topic hz camera/rgb --seconds 10
    """
    expression = key_expression(keys, robot)
    rates: defaultdict[str, Rate] = defaultdict(Rate)
    with listening(robot, router, secure) as bus:
        # Counted on Zenoh's thread, where the time of arrival is true; one subscription, so one thread.
        bus.listen(expression, lambda key, payload, _: rates[key].add(len(payload), time.monotonic()))
        wait(expression, seconds)
    if as_json:
        say(json.dumps({key: rate.record() for key, rate in sorted(rates.items())}, indent=2))
    elif not rates:
        _silence(expression)
    else:
        say("\n".join(rate_lines(rates)))


def bw(
    keys: Keys = None,
    seconds: Seconds = 5.0,
    as_json: Json = False,
    robot: Robot = DEFAULT_ROBOT,
    router: Router = None,
    secure: Secure = None,
) -> None:
    """Measure bandwidth and size of messages.

    Of each key, and in total. The bandwidth is that of the payloads over the whole time of listening. Listening to
    raw images costs their bandwidth once more.

    Example: smal topic bw 'camera/*' --seconds 10
    """
    expression = key_expression(keys, robot)
    sizes: defaultdict[str, Sizes] = defaultdict(Sizes)
    started_s = time.monotonic()
    with listening(robot, router, secure) as bus:
        bus.listen(expression, lambda key, payload, _: sizes[key].add(len(payload)))
        started_s = time.monotonic()
        wait(expression, seconds)
    elapsed_s = time.monotonic() - started_s
    if as_json:
        keyed = {key: one.record(elapsed_s) for key, one in sorted(sizes.items())}
        say(json.dumps({"seconds": elapsed_s, "keys": keyed, "total": total(sizes).record(elapsed_s)}, indent=2))
    elif not sizes:
        _silence(expression)
    else:
        say("\n".join(bandwidth_lines(sizes, elapsed_s)))


def key_expression(keys: str | None, robot: str) -> str:
    """Return a key expression as it is, or that of a topic's short name, or of everything, for one robot."""
    if keys is None:
        return f"{ROOT}/{robot}/**"
    return keys if keys == ROOT or keys.startswith((f"{ROOT}/", "*")) else f"{ROOT}/{robot}/{keys}"


@contextmanager
def listening(robot: str, router: str | None, secure: Path | None) -> Iterator[Bus]:
    """Connect to the bus; Ctrl-C, and a reader that closed the pipe, end the listening and nothing else."""
    with closing(settings_for(robot, router, secure).open_bus("watcher", CONNECT_S)) as bus:
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
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def _silence(expression: str) -> None:
    typer.echo(f"smal: nothing was published on {expression}", err=True)
