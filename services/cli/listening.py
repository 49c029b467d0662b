"""``smal topic echo`` and ``hz``: print and measure the messages on the bus."""

import json
import os
import sys
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Annotated, Any, Final, cast

import numpy as np
import typer
from typer import Argument, Option

from schemas.base import Message
from schemas.codec import DecodeError, decode, printable
from schemas.topics import ROOT, TOPICS, key_of, topic_of
from services.cli import options
from services.experiments.words import number, table
from services.kit.bus import Bus
from services.kit.errors import UsageError
from services.kit.inbox import Inbox

QUEUE: Final = 64  # Maximum number of samples kept while the terminal is slower than the bus.
CONNECT_S: Final = 2.0
MOST_ITEMS: Final = 12
#: Columns of the table: name of the figure and factor to its unit.
FIGURES: Final = {
    "Hz": ("rate_hz", 1.0), "min ms": ("min_s", 1e3), "max ms": ("max_s", 1e3), "std dev ms": ("std_s", 1e3),
    "kB/s": ("bytes_per_s", 1e-3), "mean kB": ("mean_bytes", 1e-3), "max kB": ("max_bytes", 1e-3),
}  # fmt: skip
Keys = Annotated[
    str | None,
    Argument(
        metavar="[KEYEXPR]", help="Key expression, or topic. [default: all topics of the robot]"
    ),
]
Seconds = Annotated[
    float, Option(min=0.1, max=3600, help="Duration, seconds; Ctrl-C ends earlier.")
]


@dataclass(frozen=True)
class Sample:
    """A sample as received from the bus."""

    key: str
    payload: bytes
    encoding: str

    def decoded(self) -> Message:
        """Decode the message; raise DecodeError if the key is no topic or the payload does not match."""
        topic = topic_of(self.key)
        if topic is None:
            raise DecodeError("not a topic of SMAL")
        message = decode(topic.message, self.payload, self.encoding)
        if key_of(message) != self.key:
            raise DecodeError(f"contains a message of {message.robot}/{message.topic_name}")
        return message

    def record(self) -> dict[str, object]:
        """Return the sample for JSON: the fields (of binary data the length), or the error."""
        try:
            return {"key": self.key, "message": _without_binary(self.decoded().model_dump())}
        except DecodeError as error:
            return {"key": self.key, "error": str(error), "bytes": len(self.payload)}

    def line(self) -> str:
        """Return the sample as one line of text."""
        try:
            fields = self.decoded().model_dump(exclude={"robot"})
        except DecodeError as error:
            return f"{printable(self.key)}  not decodable ({len(self.payload)} bytes): {error}"
        return f"{printable(self.key)}  " + " ".join(
            f"{name}={_text(value)}" for name, value in fields.items()
        )


def figures(arrivals: Sequence[tuple[float, int]], elapsed_s: float) -> dict[str, Any]:
    """Return count, rate, regularity, sizes and bandwidth of messages, from their times (s) and bytes."""
    times_s, sizes = np.array(arrivals).T
    gaps_s = np.diff(times_s)
    spread: dict[str, float | None] = dict.fromkeys(("min_s", "max_s", "std_s"))
    if gaps_s.size:
        spread = {
            "min_s": float(gaps_s.min()),
            "max_s": float(gaps_s.max()),
            "std_s": float(gaps_s.std()),
        }
    return {
        "messages": len(sizes),
        "rate_hz": 1.0 / float(gaps_s.mean()) if gaps_s.any() else None,
        **spread,
        "bytes_per_s": float(sizes.sum()) / elapsed_s,
        "mean_bytes": float(sizes.mean()),
        "max_bytes": int(sizes.max()),
    }


def echo(
    *,
    keys: Keys = None,
    count: Annotated[int | None, Option(min=1, help="Maximum number of messages.")] = None,
    as_json: options.Json = False,
    reach: options.Reach,
) -> None:
    """Print every message until Ctrl-C.

    Each message is one line, or with --json one JSON object. Binary data are printed as their
    length.

    Example: smal topic echo 'command/*' --json --count 5
    """
    expression = key_expression(keys, reach.robot)
    inbox = Inbox()
    inbox.open("samples", QUEUE)
    with _listening(reach) as bus:
        bus.listen(
            expression,
            lambda key, payload, encoding: inbox.put(
                "samples", Sample(key, payload, encoding), len(payload)
            ),
        )
        printed = 0
        while printed != count:
            item = inbox.take(None)
            if item is not None:
                sample = cast("Sample", item[1])
                say(json.dumps(sample.record()) if as_json else sample.line())
                printed += 1
    if inbox.dropped["samples"]:
        typer.echo(
            f"smal: {inbox.dropped['samples']} messages were too fast to print",
            err=True,
        )


def hz(
    *,
    keys: Keys = None,
    seconds: Seconds = 5.0,
    as_json: options.Json = False,
    reach: options.Reach,
) -> None:
    """Measure rate, regularity and size of the messages of each topic.

    The rate is measured between the first and the last message. The bandwidth is the size of all
    payloads over the whole duration. Measuring images transfers them once more.

    Example: smal topic hz camera/jpeg --seconds 10
    """
    expression = key_expression(keys, reach.robot)
    heard: defaultdict[str, list[tuple[float, int]]] = defaultdict(list)
    began_s = time.monotonic()
    with _listening(reach) as bus:
        # Timed on Zenoh's thread for exact arrival times; one subscription runs on one thread.
        bus.listen(
            expression, lambda key, payload, _: heard[key].append((time.monotonic(), len(payload)))
        )
        began_s = time.monotonic()
        wait(expression, seconds)
    elapsed_s = time.monotonic() - began_s
    found = {key: figures(one, elapsed_s) for key, one in sorted(heard.items())}
    if not found:
        typer.echo(f"smal: no messages on {expression}", err=True)
    if as_json:
        say(json.dumps(found, indent=2))
    elif found:
        say("\n".join(lines(found)))


def lines(found: dict[str, dict[str, Any]]) -> Iterator[str]:
    """Yield the figures of each key as lines of a table."""
    rows = [["key", "messages", *FIGURES]]
    for key, one in found.items():
        cells = (number(one[name], scale) for name, scale in FIGURES.values())
        rows.append([printable(key), str(one["messages"]), *cells])
    return table(rows)


def key_expression(keys: str | None, robot: str) -> str:
    """Expand a topic's short name to the key expression of a robot; keep a full key expression."""
    if keys is None:
        return f"{ROOT}/{robot}/**"
    if keys == ROOT or keys.startswith((f"{ROOT}/", "*")):
        return keys
    if "*" not in keys and keys not in TOPICS:
        raise not_found(keys)
    return f"{ROOT}/{robot}/{keys}"


def not_found(name: str) -> UsageError:
    """Return the error for an unknown topic."""
    near = get_close_matches(name, TOPICS, n=1) or ["smal topic list"]
    return UsageError(f"topic {name!r} not found; did you mean {near[0]}?")


@contextmanager
def _listening(reach: options.Reach) -> Iterator[Bus]:
    """Connect to the bus until Ctrl-C or until the reader closes the pipe."""
    with closing(reach.settings.open_bus("watcher", CONNECT_S)) as bus:
        try:
            yield bus
        except KeyboardInterrupt:
            pass
        except BrokenPipeError:
            # Python flushes standard output once more at exit; that must not fail again.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def wait(what: str, seconds: float) -> None:
    """Announce the topic and let the time pass."""
    typer.echo(f"listening to {what} for {seconds:g} s", err=True)
    time.sleep(seconds)


def say(text: str) -> None:
    """Print a line at once, also into a pipe."""
    typer.echo(text)
    sys.stdout.flush()


def _without_binary(value: object) -> object:
    """Return plain data in which each ``bytes`` is replaced by its length."""
    if isinstance(value, bytes):
        return {"bytes": len(value)}
    if isinstance(value, dict):
        return {name: _without_binary(part) for name, part in value.items()}
    return value


def _array_text(dtype: str, shape: tuple[int, ...], data: bytes) -> str:
    """Describe an array; include the first row (the likeliest place) of a belief."""
    if len(shape) == 2 and shape[0] and shape[1] <= MOST_ITEMS:
        first = np.frombuffer(data, dtype)[: shape[1]]
        return f"({' '.join(f'{number:.4g}' for number in first)}),...({shape[0]})"
    return f"<{dtype} {'x'.join(map(str, shape))}, {len(data)} bytes>"


def _text(value: object) -> str:
    match value:
        case {"dtype": dtype, "shape": tuple(shape), "data": bytes(data)}:
            return _array_text(dtype, shape, data)
        case bytes():
            return f"<{len(value)} bytes>"
        case float():
            return f"{value:.6g}"
        case ({**first}, *more):
            shown = " ".join(f"{name}={_text(part)}" for name, part in first.items())
            return f"({shown})" + (f",...({1 + len(more)})" if more else "")
        case tuple() if len(value) > MOST_ITEMS:
            return ",".join(map(str, value[:MOST_ITEMS])) + f",...({len(value)})"
        case tuple():
            return ",".join(map(str, value)) or "()"
        case None:
            return "-"
        case _:
            return printable(str(value))
