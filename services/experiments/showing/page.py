"""The page of what a model has learned: one HTML file that needs nothing beside it, and its figures."""

from collections.abc import Iterator, Mapping, Sequence
from html import escape
from itertools import count
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from schemas.codec import printable
from services.experiments import html
from services.experiments.drawing import (
    BACK,
    COLOURS,
    DASHES,
    LINE,
    MUTED,
    TEXT,
    WIDTH_IN,
    legend,
    styled,
)
from services.experiments.drawing import figure as new_figure
from services.experiments.showing.drives import TaughtDrives
from services.experiments.showing.summary import facts, goals_of, taught_drives
from services.experiments.showing.ways import Believed, Ways, believed
from services.experiments.words import counted
from services.recordings.recorded import episode_of
from smal.model import Model
from smal.paper.model import PaperModel
from smal.planning import cost_to_go
from smal.teaching.demonstration import Demonstration

_SHOWN: Final = 5  # Frames of a drive that are shown, spread over it.
MOST_NAMED: Final = len(COLOURS)  # As many lines as there are colours are told apart, and named.
_FORK = "D"
_MEETING = "s"


def write_page(
    folder: Path,
    model: Model | PaperModel,
    file: Path,
    drives: TaughtDrives | None,
    advance: html.Advance = lambda _what, _done, _total: None,
) -> Path:
    """Write the page of a model's file, with what recordings hold of it; ValueError names a damaged image's episode."""
    found = {} if drives is None else drives.found
    body = [
        *_missing(drives),
        *(_map(model, found, advance) if isinstance(model, Model) else ()),
        *_seen(model, found),
        "<h2>The model</h2>",
        html.table(["of", "is"], facts(model, str(file), file.stat().st_size).items(), left=2),
    ]
    return html.write_page(folder, f"SMAL: what {printable(file.name)} has learned", body)


def _missing(drives: TaughtDrives | None) -> Iterator[str]:
    if drives is None:
        yield (
            '<p class="note" role="note"><b>Without images.</b> A model keeps features of images, and no image; '
            "<code>--recordings DIR</code> names the recordings that it was taught from.</p>"
        )
    elif drives.missing:
        items = "".join(f"<li>{escape(line)}</li>" for line in drives.missing)
        count = (
            f"{len(drives.missing)} of {counted(len(drives.missing) + len(drives.found), 'drive')}"
        )
        yield f'<div class="note" role="note"><b>Missing:</b> {count}.<ul>{items}</ul></div>'


def _seen(model: Model | PaperModel, found: dict[int, Demonstration]) -> Iterator[str]:
    """Show each drive that is there in some frames; name all."""
    taught = taught_drives(model)
    names = [printable(", ".join(one.parts)) for one in taught]
    yield "<h2>The drives</h2>"
    for number, one in found.items():
        assert one.images is not None  # noqa: S101 - those that are found have them
        frames = np.unique(np.linspace(0, len(one.atoms) - 1, _SHOWN).astype(int)).tolist()
        yield html.strip({f"{names[number]}, frame {frame}": one.images[frame] for frame in frames})
    rows = [
        [
            names[number],
            printable(one.end),
            "there" if number in found else "not there",
            f"{one.frames:,}",
        ]
        for number, one in enumerate(taught)
    ]
    yield html.table(["name", "leads", "recording", "frames"], rows, left=3)


def _map(model: Model, drives: Mapping[int, Demonstration], advance: html.Advance) -> Iterator[str]:
    ways = Ways(model.mapped)
    names = [printable(episode_of(parts[0])) for parts in model.mapped.names]
    total = sum(len(one.atoms) for one in drives.values())
    done = count(1)
    believed_on = {}
    for number, one in drives.items():
        believed_on[number] = believed(
            model, ways, number, one, lambda: advance("recognizing", next(done), total)
        )
    yield "<h2>The taught ways</h2>"
    yield from _ways(ways, goals_of(model), names, believed_on)
    yield "<h2>Cost to go</h2>"
    yield from _costs(ways, goals_of(model), names)
    yield "<h2>Where the belief was wide</h2>"
    yield from _belief(ways, names, believed_on)


def _ways(
    ways: Ways, goals: Sequence[str], names: Sequence[str], believed_on: Mapping[int, Believed]
) -> Iterator[str]:
    how = (
        "by odometry"
        if ways.map.odometry
        else "by what atoms usually do, since they are without odometry"
    )
    said = f"{counted(len(names), 'drive')} {how}; {counted(int(ways.shared.sum()), 'keyframe')} shared by drives."
    yield html.titled(draw_ways(ways, goals, believed_on), "Where they run", said)
    lines = []
    for number, one in enumerate(ways.partings, 1):
        here = int(ways.of[one.keyframe])
        others = " and ".join(names[drive] for drive in one.drives if drive != here)
        what = "fork" if one.fork else "the ways meet"
        lines.append(
            f"{number}: {what} {ways.way[one.keyframe]:.1f} {ways.unit} along {names[here]}, with {others}"
        )
    if lines:
        yield f"<ul>{''.join(f'<li>{escape(line)}</li>' for line in lines)}</ul>"
    elif len(names) > 1:
        yield "<p>Nowhere do shared ways part or meet.</p>"


def _costs(ways: Ways, goals: Sequence[str], names: Sequence[str]) -> Iterator[str]:
    pictures = []
    no_way = []
    for goal in goals:
        costs, _ = cost_to_go(ways.map, goal)
        said = f"Time to {escape(goal)} from each place of the drives, going over to another one where that is sooner."
        drawn = draw_cost_to_go(ways, costs, names)
        pictures.append(html.titled(drawn, f"Cost to go to {goal}", said))
        for drive, name in enumerate(names):
            if not np.isfinite(costs[ways.of == drive]).any():
                no_way.append(f"<p>{escape(f'No taught way leads from {name} to {goal}.')}</p>")
    yield f'<div class="pair">{"".join(pictures)}</div>'
    yield from no_way


def _belief(ways: Ways, names: Sequence[str], believed_on: Mapping[int, Believed]) -> Iterator[str]:
    if not believed_on:
        yield "<p>Recognition was not run: none of the drives' recordings is there.</p>"
        return
    pictures = []
    rows = []
    for drive, one in believed_on.items():
        widest = int(one.spread.argmax())
        pictures.append(html.titled(draw_belief(ways, one), names[drive], ""))
        rows.append([
            names[drive], f"{np.median(one.here):.0%}", f"{(one.here < 0.5).mean():.0%}",
            f"{one.spread[widest]:.2f} {ways.unit} at {widest * ways.map.tick_s:.1f} s", f"{one.lost.max():.0%}",
        ])  # fmt: skip
    yield (
        "<p>Recognition follows the drives that it was taught from once more. “Where it was” is the part of the "
        f"belief within {ways.map.correlation_length:.2f} {ways.unit} of the robot, the way over which views become "
        "half as alike; the belief is wide where that is less than half.</p>"
    )
    yield f'<div class="pair">{"".join(pictures)}</div>'
    head = ["drive", "where it was, median", "of the time wide", "largest spread", "lost, at most"]
    yield html.table(head, rows, left=1)


def _look(number: int) -> dict[str, Any]:
    return {"color": COLOURS[number % len(COLOURS)], "ls": DASHES[number % len(DASHES)]}


def _mark(
    axes: Axes,
    at: NDArray[np.float64],
    marker: str,
    size: float,
    label: str,
    **style: Any,  # noqa: ANN401
) -> None:
    usual: dict[str, Any] = {"mec": BACK, "ls": "", "zorder": 5}
    axes.plot(*at.T, marker, ms=size, label=label, **usual | style)


@styled
def draw_ways(ways: Ways, goals: Sequence[str], believed: Mapping[int, Believed]) -> Figure:
    """Draw the taught ways, those that are joined in one picture, and where they part and meet."""
    places = ways.key_poses[:, :2]
    groups = [np.flatnonzero(ways.groups == group) for group in range(int(ways.groups.max()) + 1)]
    figure = new_figure(0.7 * WIDTH_IN * len(groups) + 1.1)
    panels = list(figure.subplots(len(groups), 1, squeeze=False)[:, 0])
    for axes, drives in zip(panels, groups, strict=True):
        axes.set_aspect("equal", adjustable="datalim")
        axes.set(xlabel=ways.unit, ylabel=ways.unit)
        axes.margins(0.12)
        for drive in drives.tolist():
            keys = np.flatnonzero(ways.of == drive)
            _draw_way(axes, ways, places[keys], ways.shared[keys], drive, goals)
            if drive in believed:
                frames = ways.map.keyframes[keys] - int(np.searchsorted(ways.map.drives, drive))
                wide = keys[believed[drive].here[frames] < 0.5]
                if wide.size:
                    _mark(
                        axes,
                        places[wide],
                        "o",
                        9,
                        "wide belief",
                        mfc="none",
                        mec=COLOURS[1],
                        zorder=3,
                    )
        for number, one in enumerate(ways.partings, 1):
            if one.drives[0] in drives:
                label, marker = ("fork", _FORK) if one.fork else ("ways meet", _MEETING)
                _mark(axes, places[one.keyframe], marker, 8, label, color=TEXT)
                x, y = places[one.keyframe].tolist()
                axes.annotate(
                    str(number), (x, y), (7, 5), textcoords="offset points", weight="bold", zorder=9
                )
    legend(figure, panels, 3)
    return figure


def _draw_way(
    axes: Axes,
    ways: Ways,
    way: NDArray[np.float64],
    shared: NDArray[np.bool_],
    drive: int,
    goals: Sequence[str],
) -> None:
    goal = ways.map.goals[drive]
    line = _look(goals.index(goal))
    if shared.any():
        axes.plot(
            *np.where(shared[:, None], way, np.nan).T, color=LINE, lw=7, label="shared", zorder=1
        )
    axes.plot(*way.T, lw=1.6, label=f"to {goal}", zorder=2, **line)
    _mark(axes, way[0], "o", 6, "start", mfc=BACK, mec=TEXT)
    _mark(axes, way[-1], "*", 12, f"goal {goal}", color=line["color"])


@styled
def draw_cost_to_go(ways: Ways, costs: NDArray[np.float64], names: Sequence[str]) -> Figure:
    """Draw the time to a goal along each drive from which a way leads there."""
    figure = new_figure(2.6)
    axes = figure.add_subplot()
    for drive, name in enumerate(names):
        on = ways.of == drive
        if np.isfinite(costs[on]).any():
            label = (
                (name if len(name) <= 30 else f"{name[:29]}…") if len(names) <= MOST_NAMED else None
            )
            axes.plot(ways.way[on], costs[on], lw=1.6, label=label, **_look(drive))
    axes.set(xlabel=f"along the drive ({ways.unit})", ylabel="to go (s)")
    axes.set_xlim(left=0)
    axes.set_ylim(bottom=0)
    legend(figure, [axes])
    return figure


@styled
def draw_belief(ways: Ways, believed: Believed) -> Figure:
    """Draw where the belief was along a drive: here, elsewhere, or nowhere."""
    figure = new_figure(3.4)
    shares, spread = figure.subplots(2, 1, sharex=True)
    time_s = np.arange(len(believed.here)) * ways.map.tick_s
    parts = [believed.here, 1.0 - believed.here - believed.lost, believed.lost]
    labels = ["where it was", "elsewhere on the ways", "lost"]
    colours = [COLOURS[0], COLOURS[1], MUTED]
    shares.stackplot(time_s, parts, labels=labels, colors=colours, lw=0, alpha=0.7)
    shares.set(ylabel="belief", ylim=(0, 1), xlim=(0, max(float(time_s[-1]), ways.map.tick_s)))
    spread.plot(time_s, believed.spread, color=COLOURS[0], lw=1.6)
    spread.axhline(ways.map.correlation_length, color=MUTED, ls=":", label="views half as alike")
    spread.set(xlabel="time (s)", ylabel=f"spread ({ways.unit})")
    spread.set_ylim(bottom=0)
    legend(figure, [shares, spread])
    return figure
