"""``smal topic``: what can be heard on the bus, and what is heard."""

from __future__ import annotations

import json
import os
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import closing, contextmanager
from difflib import get_close_matches
from typing import Annotated, Final, cast

import typer

from schemas.codec import encoding_of
from schemas.topics import ROOT, TOPICS, Topic, topic_of
from services.bus import DEFAULT_ROUTER, Bus
from services.commands.errors import UsageError
from services.commands.options import DEFAULT_ROBOT, Json, Robot, Router, check_robot
from services.commands.rates import Rate, rate_lines
from services.commands.samples import Sample
from services.process import Inbox

#: Samples kept while the terminal is slower than the bus; a raw frame takes 2.4 MB.
QUEUE: Final = 64
CONNECT_S: Final = 2.0
Keys = Annotated[str, typer.Argument(help="Key expression, or a topic's name such as camera/rgb.", metavar="KEYEXPR")]

app = typer.Typer(
    help="List the topics; listen to them.\n\nExample: smal topic echo state --count 5",
    no_args_is_help=True,
    rich_markup_mode=None,
)


@app.command("list")
def list_topics(
    as_json: Json = False,
    as_markdown: Annotated[bool, typer.Option("--markdown", help="Print a Markdown table.")] = False,
) -> None:
    """List every topic; needs no running stack."""
    rows = [_row(topic) for topic in TOPICS.values()]
    if as_json:
        _say(json.dumps(rows, indent=2))
    elif as_markdown:
        _say(markdown_table())
    else:
        for line in _columns([["topic", "message", "Hz", "from", "meaning"], *map(_cells, TOPICS.values())]):
            _say(line.replace("``", ""))


@app.command("info")
def info(
    name: Annotated[str, typer.Argument(help="Topic, for example state.")],
    robot: Robot = DEFAULT_ROBOT,
    as_json: Json = False,
) -> None:
    """Describe one topic and the JSON Schema of its messages; needs no running stack."""
    topic = TOPICS.get(name) or topic_of(name)
    if topic is None:
        near = get_close_matches(name, TOPICS, n=1) or ["smal topic list"]
        raise UsageError(f"no topic {name!r}; did you mean: {near[0]}?")
    row = _row(topic) | {
        "key": topic.key(check_robot(robot)),
        "encoding": encoding_of(topic.message),
        "most_bytes": topic.message.max_bytes,
        "queue": topic.queue,
        "recorded": topic.recorded,
    }
    schema = topic.message.model_json_schema()
    if as_json:
        _say(json.dumps(row | {"schema": schema}, indent=2))
        return
    for label, value in row.items():
        _say(f"{label:10}  {value}")
    _say(json.dumps(schema, indent=2))


@app.command("echo")
def echo(
    keys: Keys = f"{ROOT}/**",
    count: Annotated[int | None, typer.Option(min=1, help="End after this many messages.")] = None,
    as_json: Json = False,
    robot: Robot = DEFAULT_ROBOT,
    router: Router = DEFAULT_ROUTER,
) -> None:
    """Print every message, one line each, until Ctrl-C."""
    inbox = Inbox()
    inbox.open("samples", QUEUE)
    with closing(Bus(check_robot(robot), router, CONNECT_S)) as bus, _ends_quietly():
        bus.listen(key_expression(keys, robot), lambda *sample: inbox.put("samples", Sample(*sample)))
        printed = 0
        while printed != count:
            item = inbox.take(None)
            if item is not None:
                sample = cast("Sample", item[1])
                _say(json.dumps(sample.record()) if as_json else sample.line())
                printed += 1
    if inbox.dropped["samples"]:
        typer.echo(f"smal: {inbox.dropped['samples']} messages came faster than they were printed", err=True)


@app.command("hz")
def hz(
    keys: Keys = f"{ROOT}/**",
    seconds: Annotated[float, typer.Option(min=0.1, max=86400, help="How long to listen.")] = 5.0,
    as_json: Json = False,
    robot: Robot = DEFAULT_ROBOT,
    router: Router = DEFAULT_ROUTER,
) -> None:
    """Measure rate and bandwidth of each key."""
    expression = key_expression(keys, robot)
    rates: defaultdict[str, Rate] = defaultdict(Rate)
    with closing(Bus(check_robot(robot), router, CONNECT_S)) as bus, _ends_quietly():
        # Counted on Zenoh's thread, where the time of arrival is true; one subscription, so one thread.
        bus.listen(expression, lambda key, payload, _: rates[key].add(len(payload), time.monotonic()))
        typer.echo(f"listening to {expression} for {seconds:g} s", err=True)
        time.sleep(seconds)
    if as_json:
        _say(json.dumps({key: rate.record() for key, rate in sorted(rates.items())}, indent=2))
    elif not rates:
        typer.echo(f"smal: nothing was published on {expression}", err=True)
    else:
        _say("\n".join(rate_lines(rates)))


def key_expression(keys: str, robot: str) -> str:
    """Return a key expression as it is, or that of a topic's short name for one robot."""
    return keys if keys == ROOT or keys.startswith((f"{ROOT}/", "*")) else f"{ROOT}/{robot}/{keys}"


def markdown_table() -> str:
    """Return the table of topics as Markdown, as the README shows it."""
    rows = [f"| `{name}` | `{message}` | {rate} | {producer} | {meaning} |"
            for name, message, rate, producer, meaning in map(_cells, TOPICS.values())]  # fmt: skip
    return "\n".join(["| topic | message | Hz | from | meaning |", "|---|---|---|---|---|", *rows]).replace("``", "`")


def _row(topic: Topic) -> dict[str, object]:
    return {
        "name": topic.name,
        "message": topic.message.schema_name(),
        "rate_hz": topic.rate_hz,
        "producer": topic.producer,
        "meaning": topic.meaning,
    }


def _cells(topic: Topic) -> list[str]:
    rate = "event" if topic.rate_hz is None else f"{topic.rate_hz:g}"
    return [topic.name, topic.message.schema_name(), rate, topic.producer, topic.meaning]


def _columns(rows: list[list[str]]) -> Iterator[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        yield "  ".join(f"{cell:{width}}" for cell, width in zip(row, widths, strict=True)).rstrip()


def _say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


@contextmanager
def _ends_quietly() -> Iterator[None]:
    """Take Ctrl-C, and a reader that closed the pipe, for the end of listening."""
    try:
        yield
    except KeyboardInterrupt:
        pass
    except BrokenPipeError:
        # Python flushes standard output once more at exit; that must not fail again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
