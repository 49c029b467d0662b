"""``smal topic``: describe, print and measure the topics on the bus."""

import json
import shutil
from contextlib import closing
from typing import Annotated

import typer
from typer import Argument, Option

from schemas.codec import encoding_of
from schemas.topics import TOPICS, Topic, topic_of
from services.cli import options
from services.cli.grouping import STYLE, grouped
from services.cli.listening import CONNECT_S, echo, hz, not_found, say
from services.cli.stack import answers, instances
from services.experiments.words import table
from services.table import SERVICES, givers, graph, takers

app = typer.Typer(
    help="List topics; print and measure messages.\n\nExample: smal topic echo state --count 5",
    **STYLE,
)


@app.command("list")
def list_topics(
    as_json: options.Json = False,
    as_markdown: Annotated[bool, Option("--markdown", help="Output as a Markdown table.")] = False,
) -> None:
    """List every topic; works without a running stack.

    `smal topic info TOPIC` describes a topic completely.

    Example: smal topic list --json
    """
    if as_json:
        say(json.dumps([_row(topic) for topic in TOPICS.values()], indent=2))
    elif as_markdown:
        rows = [f"| `{name}` | `{message}` | {rate} | {giver} | {takers} | {meaning} |"
                for name, message, rate, giver, takers, meaning in map(_cells, TOPICS.values())]  # fmt: skip
        headings = ["| topic | message | Hz | from | to | meaning |", "|---|---|---|---|---|---|"]
        say("\n".join([*headings, *rows]).replace("``", "`"))
    else:
        cells = map(_cells, TOPICS.values())
        lines = [[one[0], one[2], one[-1].replace("``", "")] for one in cells]
        columns = shutil.get_terminal_size().columns
        for line in table([["topic", "Hz", "meaning"], *lines], left=3):
            say(line if len(line) <= columns else f"{line[: columns - 1].rstrip()}…")


@app.command("info")
def info(
    name: Annotated[str, Argument(help="Topic, for example state.")],
    robot: options.Robot = options.DEFAULT_ROBOT,
    as_json: options.Json = False,
) -> None:
    """Describe a topic and the JSON Schema of its messages; works without a running stack.

    Example: smal topic info command/teleop
    """
    topic = TOPICS.get(name) or topic_of(name)
    if topic is None:
        raise not_found(name)
    row = _row(topic) | {
        "key": topic.key(robot),
        "encoding": encoding_of(topic.message),
        "most_bytes": topic.message.max_bytes,
        "queue": topic.queue,
        "recorded": topic.recorded,
    }
    schema = topic.message.model_json_schema()
    if as_json:
        say(json.dumps(row | {"schema": schema}, indent=2))
        return
    for label, value in row.items():
        say(f"{label:10}  {', '.join(value) if isinstance(value, tuple) else value}")
    say(json.dumps(schema, indent=2))


def draw_graph(
    *,
    live: Annotated[
        bool, Option("--live", help="Running services only, with their instances and robots.")
    ] = False,
    reach: options.Reach,
) -> None:
    """Draw services and topics as a Mermaid flowchart.

    Only --live needs a running stack.

    Example: smal topic graph > graph.mmd
    """
    if not live:
        say(graph())
        return
    with closing(reach.settings.open_bus("watcher", CONNECT_S)) as bus:
        there = {name: list[str]() for name in SERVICES if answers(bus, name) is not None}
        found = instances(bus)
    lines = {
        name: [f"{one}: {' '.join(robots)}" for one, robots in by.items()]
        for name, by in found.items()
    }
    say(graph(there | lines))


for name, command in (("echo", echo), ("hz", hz), ("graph", draw_graph)):
    app.command(name)(grouped(command))


def _row(topic: Topic) -> dict[str, object]:
    return {
        "name": topic.name,
        "message": topic.message.schema_name(),
        "rate_hz": topic.rate_hz,
        "from": givers(topic),
        "to": takers(topic),
        "meaning": topic.meaning,
    }


def _cells(topic: Topic) -> list[str]:
    rate = "event" if topic.rate_hz is None else f"{topic.rate_hz:g}"
    ends = (", ".join(names) for names in (givers(topic), takers(topic)))
    return [topic.name, topic.message.schema_name(), rate, *ends, topic.meaning]
