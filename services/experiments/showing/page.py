"""The page of what a model has learned: one HTML file, with images in a folder beside it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from schemas.codec import printable
from services.experiments import html
from services.experiments.drawing import svg
from services.experiments.showing import figures
from services.experiments.showing.drives import TaughtDrives, first_seen
from services.experiments.showing.summary import facts, goals_of, state_graph
from services.experiments.showing.ways import Believed, Ways, believed
from services.kit.jpeg import encode_jpeg, shrunk
from services.recordings.taught import episode_of
from smal.demonstration import Demonstration, drives_to_goals
from smal.model import Model
from smal.movement import Atom
from smal.paper.model import Model as PaperModel
from smal.planning import cost_to_go

#: Shares of a drive at which its cost to go stands in the table.
_SHARES: Final = (0.0, 0.25, 0.5, 0.75, 1.0)
#: Frames of a drive or a state that are shown, spread over it; how wide, pixels: as a telephone, twice.
_SHOWN: Final = 5
_FRAME_PX, _GAP_PX = 160, 4
#: Of many states, so many are named.
_NAMED: Final = 10
_ARROWS: Final = {Atom.STOP: "■", Atom.FORWARD: "↑", Atom.BACKWARD: "↓", Atom.LEFT: "↰", Atom.RIGHT: "↱"}
#: Called with what is being done, how much of it is and how much there is.
Advance = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class _Shown:
    """Parameters of `write_page`."""

    folder: Path
    file: Path
    found: TaughtDrives | None
    advance: Advance


def write_page(
    folder: Path,
    model: Model | PaperModel,
    file: Path,
    found: TaughtDrives | None,
    advance: Advance = lambda _what, _done, _total: None,
) -> Path:
    """Write ``index.html`` and its images into a folder that is there, and return its path.

    ``file`` is the model's, and ``found`` what recordings hold of its drives; None where none are given.

    Raises
    ------
    ValueError
        An image of a recording is damaged; the text names its episode.
    """
    path, shown = folder / "index.html", _Shown(folder, file, found, advance)
    body = [*(_map_page(shown, model) if isinstance(model, Model) else _paper_page(shown, model))]
    title = f"SMAL: what {printable(file.name)} has learned"
    path.write_text(html.page(title, "\n".join(body), 72), encoding="utf-8")
    return path


# -- the page of a map ------------------------------------------------------------------------------------------------


def _map_page(shown: _Shown, model: Model) -> Iterator[str]:
    taught, ways, goals = model.mapped, Ways(model.mapped), goals_of(model)
    names = [printable(episode_of(parts[0])) for parts in taught.names]
    drives = _whole_drives(shown, model)
    believed_on = _believed(shown, model, ways, drives)
    yield html.tiles(
        {
            "drives": str(len(taught.goals)),
            "frames": f"{len(taught.poses):,}",
            "goals": ", ".join(goals),
            "keyframes": f"{len(taught.keyframes):,}",
            "shared by drives": str(int(ways.shared.sum())),
        }
    )
    yield from _missing(shown.found, sum(map(len, taught.names)))
    yield "<h2>The taught ways</h2>"
    yield from _ways(ways, goals, names, believed_on)
    yield "<h2>Cost to go</h2>"
    yield from _costs(ways, goals, names)
    yield "<h2>Where the belief was wide</h2>"
    yield from _belief(ways, names, believed_on)
    yield "<h2>What it looked like</h2>"
    yield from _seen(shown, ways, names, drives)
    yield from _model(shown, model)
    rows = [
        [printable(", ".join(parts)), printable(goal), "there" if drive in drives else "not there", f"{count:,}"]
        for drive, (parts, goal, count) in enumerate(
            zip(taught.names, taught.goals, taught.frames.tolist(), strict=True)
        )
    ]
    yield html.table(["name", "goal", "recording", "frames"], rows, left=3)


def _whole_drives(shown: _Shown, model: Model) -> dict[int, Demonstration]:
    """Return the drives of the map that recordings hold as a whole, by number."""
    known = [] if shown.found is None else [one for one in shown.found.demonstrations if one is not None]
    whole = dict(drives_to_goals(known))
    numbered = enumerate(zip(model.mapped.names, model.mapped.frames.tolist(), strict=True))
    return {drive: whole[parts] for drive, (parts, frames) in numbered
            if parts in whole and len(whole[parts].atoms) == frames}  # fmt: skip


def _believed(shown: _Shown, model: Model, ways: Ways, drives: Mapping[int, Demonstration]) -> dict[int, Believed]:
    """Let recognition follow each drive of the map whose recording is there."""
    total, found, before = sum(len(drive.atoms) for drive in drives.values()), {}, 0
    for number, drive in drives.items():

        def advance(frame: int, before: int = before) -> None:
            shown.advance("recognizing", before + frame + 1, total)

        found[number] = believed(model, ways, number, drive, advance)
        before += len(drive.atoms)
    return found


def _ways(ways: Ways, goals: Sequence[str], names: Sequence[str], believed_on: Mapping[int, Believed]) -> Iterator[str]:
    how = "by odometry" if ways.map.odometry else "by what atoms usually do, since they are without odometry"
    said = f"{_counted(len(names), 'drive')} {how}."
    yield _figure(figures.draw_ways(ways, goals, believed_on), "ways", "Where they run", said)
    lines = []
    for number, one in enumerate(ways.partings, 1):
        along = float(ways.way[ways.map.keyframes[one.keyframe]])
        here = int(ways.of[one.keyframe])
        others = " and ".join(names[drive] for drive in one.drives if drive != here)
        what = "fork" if one.fork else "the ways meet"
        lines.append(f"{number}: {what} {along:.1f} {ways.unit} along {names[here]}, with {others}")
    if lines:
        yield f"<ul>{''.join(f'<li>{escape(line)}</li>' for line in lines)}</ul>"
    elif len(names) > 1:
        yield "<p>Nowhere do shared ways part or meet.</p>"


def _costs(ways: Ways, goals: Sequence[str], names: Sequence[str]) -> Iterator[str]:
    pictures, rows, no_way = [], [], []
    for number, goal in enumerate(goals):
        costs, _ = cost_to_go(ways.map, goal)
        said = f"Time to {escape(goal)} from each place of the drives, going over to another one where that is sooner."
        drawn = figures.draw_cost_to_go(ways, costs, names)
        pictures.append(_figure(drawn, f"costs{number}", f"Cost to go to {goal}", said))
        for drive, name in enumerate(names):
            on = costs[ways.of == drive]
            where = np.round(np.array(_SHARES) * (on.size - 1)).astype(int)
            cells = (f"{cost:.1f} s" if np.isfinite(cost) else "no way" for cost in on[where].tolist())
            rows.append([goal, name, *cells])
            if not np.isfinite(on).any():
                no_way.append(f"<p>{escape(f'No taught way leads from {name} to {goal}.')}</p>")
    yield f'<div class="pair">{"".join(pictures)}</div>'
    yield from no_way
    yield html.table(["to", "on the drive", "start", *(f"{one:.0%}" for one in _SHARES[1:-1]), "end"], rows, left=2)


def _belief(ways: Ways, names: Sequence[str], believed_on: Mapping[int, Believed]) -> Iterator[str]:
    if not believed_on:
        yield "<p>Recognition was not run: none of the drives' recordings is there.</p>"
        return
    pictures, rows, tick_s = [], [], ways.map.tick_s
    for drive, one in believed_on.items():
        where = ", ".join(f"{first * tick_s:.1f} to {last * tick_s:.1f} s" for first, last in one.wide()) or "nowhere"
        said = f"Less likely there than not: {where}."
        pictures.append(_figure(figures.draw_belief(ways, one), f"belief{drive}", names[drive], said))
        widest = int(one.spread.argmax())
        rows.append([
            names[drive], f"{np.median(one.here):.0%}", f"{(one.here < 0.5).mean():.0%}",
            f"{one.spread[widest]:.2f} {ways.unit} at {widest * tick_s:.1f} s", f"{one.lost.max():.0%}",
        ])  # fmt: skip
    yield (
        "<p>Recognition follows the drives that it was taught from once more. “Where it was” is the part of the "
        f"belief within {ways.map.correlation_length:.2f} {ways.unit} of the robot, the way over which views become "
        "half as alike; the belief is wide where that is less than half.</p>"
    )
    yield f'<div class="pair">{"".join(pictures)}</div>'
    head = ["drive", "where it was, median", "of the time wide", "largest spread", "lost, at most"]
    yield html.table(head, rows, left=1)


def _seen(shown: _Shown, ways: Ways, names: Sequence[str], drives: Mapping[int, Demonstration]) -> Iterator[str]:
    if not drives:
        yield "<p>None of the drives' recordings is there.</p>"
    for drive, one in drives.items():
        keys = ways.map.keyframes[ways.of == drive] - int(np.searchsorted(ways.map.drives, drive))
        frames = keys[_spread(len(keys))].tolist()
        said = escape(f"{names[drive]}: frames {', '.join(map(str, frames))}")
        picture = _strip(shown.folder / "drives" / f"{drive:05d}.jpg", one, frames, said)
        yield f"<figure>{picture}<figcaption>{said}</figcaption></figure>"


# -- the page of a model of the paper ---------------------------------------------------------------------------------


def _paper_page(shown: _Shown, model: PaperModel) -> Iterator[str]:
    names, graph = [printable(name) for name in model.names], state_graph(model)
    drives = [None] * len(names) if shown.found is None else list(shown.found.demonstrations)
    best = np.argsort(-model.reward, kind="stable")
    rewarded = best[model.reward[best] > 1e-6].tolist()
    yield html.tiles(
        {
            "drives": str(len(names)),
            "frames": f"{sum(map(len, model.atoms)):,}",
            "goal states": str(model.transitions.goals.size),
            "states": str(model.states),
            "shared by drives": str(len(graph.shared)),
            "states with reward": str(len(rewarded)),
        }
    )
    yield from _missing(shown.found, len(names))
    yield "<h2>States</h2>"
    forks = f" ({_listed([str(state) for state in graph.forks], _NAMED)})" if graph.forks else ""
    said = (
        f"{model.states} states, each of {model.sequence_length} frames; {len(graph.shared)} are shared by drives, and "
        f"at {len(graph.forks)} the drives went on differently{forks}."
    )
    yield _figure(figures.draw_states(model, graph), "states", "What follows what", said)
    yield from _states(shown, model, names, drives)
    yield "<h2>Reward</h2>"
    told = _listed([f"{state} ({model.reward[state]:.3g})" for state in rewarded], _SHOWN)
    text = (
        "<p>Ng and Russell's program looks for the reward under which the expert's actions win by the most. "
        f"It gave {len(rewarded)} of {model.states} states a reward{': ' if rewarded else ''}{told}. "
        f"V is what is to be had from a state on, at a discount of {model.gamma:g}. The policy goes by it.</p>"
    )
    drawn = figures.draw_reward(model, names)
    reward = _figure(drawn, "reward", "Reward and value along the drives", "Of the state that each frame belongs to.")
    yield f'<div class="pair">{reward}{text}</div>'
    yield from _model(shown, model)
    rows = []
    for number, (name, one) in enumerate(zip(names, drives, strict=True)):
        kind = "recovery" if model.recovery[number] else "drive"
        reached = "reached" if model.successful[number] else "not reached"
        recorded = "not there" if one is None else "there" if one.images is not None else "there, without images"
        states = len(set(model.state_streams[number].tolist()))
        rows.append([name, kind, reached, recorded, f"{len(model.atoms[number]):,}", f"{states:,}"])
    yield html.table(["name", "kind", "its end", "recording", "frames", "states"], rows, left=4)


def _states(
    shown: _Shown, model: PaperModel, names: Sequence[str], drives: Sequence[Demonstration | None]
) -> Iterator[str]:
    yield (
        "<p>By the drive that was the first to show them. Under each: the frames, what the policy does there "
        "(↑ ahead, ↰ left, ↱ right, ↓ back, ■ stop), its reward R and value V.</p>"
    )
    done, length, captions = 0, model.sequence_length, _captions(model)
    for number, new in enumerate(first_seen(model)):
        one, cards = drives[number], []
        for state, first in new.items():
            picture = ""
            if one is not None and one.images is not None:
                file = shown.folder / "states" / f"{state:05d}.jpg"
                frames = (first + _spread(length)).tolist()
                picture = _strip(file, one, frames, f"state {state}: {len(frames)} of its frames")
            said = f"frames {first} to {first + length - 1} · {captions[state]}"
            cards.append(f"<figure>{picture}<figcaption><b>State {state}</b> · {said}</figcaption></figure>")
            done += 1
            shown.advance("drawing", done, model.states)
        if cards:
            without = "" if one is not None and one.images is not None else " (without images: no recording of it)"
            said = escape(f"{names[number]}: {_counted(len(new), 'state')}{without}")
            opened = "" if number else " open"
            yield f'<details{opened}><summary>{said}</summary><div class="states">{"".join(cards)}</div></details>'


def _captions(model: PaperModel) -> list[str]:
    """Say of each state what the policy does in it, what it is worth, and how it is connected."""
    graph, goals, captions = state_graph(model), set(model.transitions.goals.tolist()), []
    for state in range(model.states):
        action, episodes, following = int(model.policy[state]), graph.episodes[state], graph.following[state]
        marks = [
            "".join(_ARROWS[Atom(atom)] for atom in model.actions[action].tolist()) if action >= 0 else "",
            f"R {model.reward[state]:.3g}, V {model.value[state]:.3g}",
            "goal" if state in goals else "",
            f"shared by {len(episodes)} drives" if len(episodes) > 1 else "",
            f"fork: goes on to {', '.join(map(str, following))}" if len(following) > 1 else "",
        ]
        captions.append(" · ".join(filter(None, marks)))
    return captions


# -- what both have ---------------------------------------------------------------------------------------------------


def _missing(found: TaughtDrives | None, drives: int) -> Iterator[str]:
    """Say which recordings of how many drives are not there."""
    if found is None:
        yield (
            '<p class="note" role="note"><b>Without images.</b> A model keeps features of images, and no image; '
            "<code>--recordings DIR</code> names the recordings that it was taught from.</p>"
        )
    elif found.missing:
        items = "".join(f"<li>{escape(line)}</li>" for line in found.missing)
        count = f"{len(found.missing)} of {drives} drives"
        yield f'<div class="note" role="note"><b>Missing:</b> {count}.<ul>{items}</ul></div>'


def _model(shown: _Shown, model: Model | PaperModel) -> Iterator[str]:
    yield "<h2>The model</h2>"
    yield html.table(["of", "is"], facts(model, str(shown.file), shown.file.stat().st_size).items(), left=2)
    yield "<h3>Drives</h3>"


def _figure(drawn: Figure, name: str, title: str, said: str) -> str:
    """Return a figure with its caption, which is HTML; the title is text."""
    caption = f"<figcaption>{said}</figcaption>"
    return f'<figure class="own"><h3>{escape(title)}</h3>{svg(drawn, name, title)}{caption}</figure>'


def _spread(count: int) -> NDArray[np.intp]:
    """Return some of so many places, spread over them."""
    return np.unique(np.linspace(0, count - 1, min(_SHOWN, count)).astype(int))


def _strip(file: Path, drive: Demonstration, frames: Sequence[int], said: str) -> str:
    """Write frames as one picture, and show it when it is looked at; the text is HTML."""
    assert drive.images is not None  # noqa: S101 - whoever asks knows
    views = [shrunk(drive.images[frame], _FRAME_PX) for frame in frames]
    gap = np.full((len(views[0]), _GAP_PX, 3), 128, np.uint8)
    whole: NDArray[np.uint8] = np.concatenate([part for view in views for part in (gap, view)][1:], axis=1)
    file.parent.mkdir(exist_ok=True)
    file.write_bytes(encode_jpeg(whole))
    height, width = whole.shape[:2]
    where = f"{file.parent.name}/{file.name}"
    return f'<img loading="lazy" src="{where}" width="{width}" height="{height}" alt="{said}">'


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'s' * (count != 1)}"


def _listed(names: Sequence[str], most: int) -> str:
    """Name some of them."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f"{', '.join(names[:most])}{more}"
