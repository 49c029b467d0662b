"""``smal topic echo`` and ``hz``: listening to what crosses the bus."""

import json
import os
import sys
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from typing import Annotated, Any, Final, cast

import numpy as np
import typer
from typer import Argument, Option

from schemas.base import Message
from schemas.codec import DecodeError, decode, printable
from schemas.topics import ROOT, key_of, topic_of
from services.cli import options
from services.experiments.words import number, table
from services.kit.bus import Bus
from services.kit.inbox import Inbox

QUEUE: Final = 64  # Samples kept while the terminal is slower than the bus.
CONNECT_S: Final = 2.0
MOST_ITEMS: Final = 12
#: Headings of the table for people, with the name of the figure and the factor to its unit.
FIGURES: Final = {
    "Hz": ("rate_hz", 1.0), "min ms": ("min_s", 1e3), "max ms": ("max_s", 1e3), "std dev ms": ("std_s", 1e3),
    "kB/s": ("bytes_per_s", 1e-3), "mean kB": ("mean_bytes", 1e-3), "max kB": ("max_bytes", 1e-3),
}  # fmt: skip
Keys = Annotated[
    str | None,
    Argument(metavar="[KEYEXPR]", help="Key expression, or a topic. [default: all of the robot]"),
]
Seconds = Annotated[
    float, Option(min=0.1, max=3600, help="How long to listen; Ctrl-C ends it earlier.")
]


@dataclass(frozen=True)
class Sample:
    """One sample as it came from the bus."""

    key: str
    payload: bytes
    encoding: str

    def decoded(self) -> Message:
        """Return the message; DecodeError where the key is no topic of SMAL, or the payload not what belongs on it."""
        topic = topic_of(self.key)
        if topic is None:
            raise DecodeError("no topic of SMAL")
        message = decode(topic.message, self.payload, self.encoding)
        if key_of(message) != self.key:
            raise DecodeError(f"holds a message of {message.robot}/{message.topic_name}")
        return message

    def record(self) -> dict[str, object]:
        """Return the sample for JSON: the fields, or why there are none; of binary data the length only."""
        try:
            return {"key": self.key, "message": _without_binary(self.decoded().model_dump())}
        except DecodeError as error:
            return {"key": self.key, "error": str(error), "bytes": len(self.payload)}

    def line(self) -> str:
        """Return the sample as one line for people."""
        try:
            fields = self.decoded().model_dump(exclude={"robot"})
        except DecodeError as error:
            return f"{printable(self.key)}  not decodable ({len(self.payload)} bytes): {error}"
        return f"{printable(self.key)}  " + " ".join(
            f"{name}={_text(value)}" for name, value in fields.items()
        )


def figures(arrivals: Sequence[tuple[float, int]], elapsed_s: float) -> dict[str, Any]:
    """Return how many came, when (s) and of how many bytes each, how regularly, and the bandwidth over all the time."""
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
            f"smal: {inbox.dropped['samples']} messages came faster than they were printed",
            err=True,
        )


def hz(
    *,
    keys: Keys = None,
    seconds: Seconds = 5.0,
    as_json: options.Json = False,
    reach: options.Reach,
) -> None:
    """Measure how often, how regularly and how large the messages of each key are.

    The rate is that between the first message and the last, also where a robot drove only for a part of the time; the
    bandwidth is that of the payloads over the whole time. Listening to images costs their bandwidth once more.

    Example: smal topic hz camera/jpeg --seconds 10
    """
    expression = key_expression(keys, reach.robot)
    heard: defaultdict[str, list[tuple[float, int]]] = defaultdict(list)
    began_s = time.monotonic()
    with _listening(reach) as bus:
        # Noted on Zenoh's thread, where the time of arrival is true; one subscription, so one thread.
        bus.listen(
            expression, lambda key, payload, _: heard[key].append((time.monotonic(), len(payload)))
        )
        began_s = time.monotonic()
        wait(expression, seconds)
    elapsed_s = time.monotonic() - began_s
    found = {key: figures(one, elapsed_s) for key, one in sorted(heard.items())}
    if not found:
        typer.echo(f"smal: nothing was published on {expression}", err=True)
    if as_json:
        say(json.dumps(found, indent=2))
    elif found:
        say("\n".join(lines(found)))


def lines(found: dict[str, dict[str, Any]]) -> Iterator[str]:
    """Yield the figures of each key as a table for people."""
    rows = [["key", "messages", *FIGURES]]
    for key, one in found.items():
        cells = (number(one[name], scale) for name, scale in FIGURES.values())
        rows.append([printable(key), str(one["messages"]), *cells])
    return table(rows)


def key_expression(keys: str | None, robot: str) -> str:
    """Return a key expression as it is, or that of a topic's short name, or of everything, for one robot."""
    if keys is None:
        return f"{ROOT}/{robot}/**"
    return keys if keys == ROOT or keys.startswith((f"{ROOT}/", "*")) else f"{ROOT}/{robot}/{keys}"


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


def _without_binary(value: object) -> object:
    """Return a copy of plain data in which every ``bytes`` has given way to its length."""
    if isinstance(value, bytes):
        return {"bytes": len(value)}
    if isinstance(value, dict):
        return {name: _without_binary(part) for name, part in value.items()}
    return value


def _array_text(dtype: str, shape: tuple[int, ...], data: bytes) -> str:
    """Describe an array; of a matrix with few columns also its first row: of a belief the likeliest place."""
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
