"""``smal recording``: describe, check and repair recordings."""

import json
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from services.cli import outputs
from services.cli.grouping import STYLE
from services.cli.options import Json, existing
from services.experiments.words import counted, number, remark, table
from services.kit.errors import UsageError
from services.kit.process import EXIT_FAILED
from services.recordings.contents import (
    Contents,
    EpisodeContents,
    contents_of,
    named_topics,
    verify,
)
from services.recordings.dataset import find_recordings
from services.recordings.repair import repair, usual_name
from services.recordings.stream import RecordingError

app = typer.Typer(
    help="Describe, check and repair recordings.\n\nExample: smal recording info drives",
    **STYLE,
)
Paths = Annotated[list[Path], Argument(help="Recordings (MCAP), or folders of recordings.")]


@app.command("info")
def info(recordings: Paths, as_json: Json = False) -> None:
    """Describe recordings: drivers, outcomes, topics, camera and sizes.

    Example: smal recording info drives --json
    """
    done, bad = _each(recordings, contents_of)
    if as_json:
        typer.echo(json.dumps([_record(one) for one in done], indent=2))
    elif done:
        typer.echo("\n\n".join("\n".join(_lines(one)) for one in done))
    if bad:
        raise typer.Exit(EXIT_FAILED)


@app.command("verify")
def check(recordings: Paths, as_json: Json = False) -> None:
    """Read recordings completely and report each problem in a line.

    The checks cover checksums, undecodable messages, missing ticks and seals. The exit status is 1
    if there is a problem.

    Example: smal recording verify drives
    """
    done, bad = _each(recordings, verify)
    if as_json:
        typer.echo(
            json.dumps(
                [{"path": str(one.path), "findings": one.findings} for one in done], indent=2
            )
        )
    else:
        for one in done:
            for finding in one.findings or ["whole"]:
                typer.echo(f"{one.path}: {finding}")
    if bad or any(one.findings for one in done):
        raise typer.Exit(EXIT_FAILED)


@app.command("repair")
def mend(
    recordings: Annotated[
        list[Path], Argument(help="Recordings (MCAP); several parts of one drive are merged.")
    ],
    out: Annotated[
        Path | None, Option(help="Repaired recording. [default: NAME.mcap, or NAME-repaired.mcap]")
    ] = None,
    replace: Annotated[
        bool, Option("--replace", help="Replacement of the damaged recording, or of --out.")
    ] = False,
) -> None:
    """Create a sealed recording from one that is damaged, unfinished or in several parts.

    After a crash the recorder continues in a new file. The damaged files stay unchanged without
    --replace. Losses are reported.

    Example: smal recording repair drives/drive-1.mcap drives/drive-1-2.mcap --out drives/whole.mcap
    """
    if out is not None and out.exists() and not replace:
        raise UsageError(f"--out {out}: already exists; choose another name, or give --replace")
    outputs.check_file(out, "--out")
    for path in recordings:
        existing(path)
    made = out or usual_name(recordings[0], replace=replace)
    before, after = repair(recordings, made, replace=replace)
    if after is None:
        typer.echo(f"{recordings[0]}: no repair needed")
        return
    count = sum(one.messages for episode in after.episodes for one in episode.topics.values())
    typer.echo(f"{made}: sealed, {counted(count, 'message')}")
    for line in (line for one in before for line in one.damage):
        typer.echo(f"  before: {line}")
    for line in after.findings:
        typer.echo(f"  lost:   {line}")


def _each(paths: list[Path], read: Callable[[Path], Contents]) -> tuple[list[Contents], int]:
    """Read each recording; return the contents and the number of failures, reported on stderr."""
    done = []
    found = find_recordings(paths)
    for path in found:
        try:
            done.append(read(path))
        except RecordingError as error:
            remark([error])
    return done, len(found) - len(done)


def _record(contents: Contents) -> dict[str, Any]:
    return {
        "path": str(contents.path),
        "state": contents.state,
        "bytes": contents.size,
        "software": contents.about.get("software"),
        "recorded_utc": contents.about.get("recorded_utc"),
        "views": {"messages": contents.views, "bytes": contents.views_size},
        "other_messages": contents.others,
        "episodes": [_episode_record(episode) for episode in contents.episodes],
    }


def _episode_record(episode: EpisodeContents) -> dict[str, Any]:
    own = {
        one.name: getattr(episode, one.name)
        for one in fields(episode)
        if one.name not in ("said", "topics")
    }
    topics = {
        name: {"messages": one.messages, "rate_hz": one.rate_hz, "bytes": one.size}
        for name, one in named_topics(episode)
    }
    return (
        own
        | episode.said
        | {"frames": episode.frames, "seconds": episode.seconds, "topics": topics}
    )


def _lines(contents: Contents) -> Iterator[str]:
    written = " ".join(
        f"{contents.about.get(name, '')}" for name in ("recorded_utc", "software")
    ).strip()
    yield (
        f"{contents.path}: {contents.size / 1e6:.1f} MB, "
        f"{contents.state}{written and f', recorded {written}'}"
    )
    for episode in contents.episodes:
        for name, value in _said(episode):
            yield f"  {name:9}  {value}"
        topics = named_topics(episode)
        rows = [
            [name, str(one.messages), number(one.rate_hz), number(one.size, 1e-6)]
            for name, one in topics
        ]
        for line in table([["topic", "messages", "Hz", "MB"], *rows]):
            yield f"  {line}"
    if contents.views:
        yield f"  views      {contents.views} messages, {contents.views_size / 1e6:.2f} MB, for Foxglove and Rerun"
    if contents.others:
        yield f"  others     {counted(contents.others, 'message')} on unknown topics"
    if not contents.episodes:
        yield "  no episode"


def _said(episode: EpisodeContents) -> Iterator[tuple[str, str]]:
    said = episode.said
    yield "episode", f"{episode.episode} of {episode.robot}"
    if said:
        judge = f" (judged by the {episode.judge})" if episode.judge else ""
        ticks = ", ".join(
            f"{name} {count}" for name, count in sorted(episode.drove.items()) if count
        )
        yield (
            "purpose",
            f"{said['purpose']} to {said['goal']} in {said['world']}, seed {said['seed']}",
        )
        yield "outcome", f"{episode.outcome or 'end not recorded'}{judge}"
        if episode.kidnapped:
            yield "kidnapped", f"before frame {', '.join(map(str, episode.kidnapped))}"
        yield "driver", f"{said['driver']}{ticks and f' (ticks: {ticks})'}"
    way = "" if episode.odometry_m is None else f", {episode.odometry_m:.1f} m by odometry"
    yield "length", f"{episode.seconds:.1f} s, {episode.frames} frames{way}"
    if episode.width is not None:
        view = (
            ""
            if episode.field_of_view_deg is None
            else f", {episode.field_of_view_deg:.0f} degrees wide"
        )
        yield "camera", f"{episode.width}x{episode.height}{view}"
