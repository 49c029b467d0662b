"""The page of what a model has learned: one HTML file, with the images of its states in a folder beside it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
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
from services.experiments.showing.belief import Believed, believed
from services.experiments.showing.drives import TaughtDrives, first_seen
from services.experiments.showing.states import StateGraph, action_of, state_graph
from services.experiments.showing.summary import facts, goals_of
from services.experiments.showing.ways import Ways
from services.kit.jpeg import encode_jpeg, shrunk
from services.recordings.taught import drives_of_map, episode_of
from smal.paper.learning import Demonstration
from smal.paper.model import Model
from smal.planning import cost_to_go

#: Frames of a state that are shown, spread over it, and how wide, pixels: a strip is as wide as a telephone, twice.
_SHOWN: Final = 5
_FRAME_PX: Final = 160
_GAP_PX: Final = 4
#: Shares of a drive at which its cost to go stands in the table.
_SHARES: Final = (0.0, 0.25, 0.5, 0.75, 1.0)


def write_page(
    folder: Path,
    model: Model,
    file: Path,
    found: TaughtDrives | None,
    advance: Callable[[str, int, int], None] = lambda _what, _done, _total: None,
) -> Path:
    """Write ``index.html`` and the images of the states into a folder.

    Parameters
    ----------
    folder
        Is there already.
    model, file
        And where it is.
    found
        What recordings hold of its drives; None where none are given.
    advance
        Called with what is being done, how much of it is and how much there is.

    Returns
    -------
    Path
        Of the page.

    Raises
    ------
    ValueError
        An image of a recording is damaged; the text names its episode.
    """
    path = folder / "index.html"
    body = _Page(folder, model, file, found, advance).body()
    path.write_text(html.page(f"SMAL: what {printable(file.name)} has learned", "\n".join(body), 72), encoding="utf-8")
    return path


class _Page:
    def __init__(
        self, folder: Path, model: Model, file: Path, found: TaughtDrives | None,
        advance: Callable[[str, int, int], None],
    ) -> None:  # fmt: skip
        self._folder, self._model, self._file, self._found, self._advance = folder, model, file, found, advance
        self._names = [printable(name) for name in model.names]
        self._demonstrations: Sequence[Demonstration | None] = (
            [None] * len(model.names) if found is None else found.demonstrations
        )
        self._graph: StateGraph = state_graph(model)
        self._ways = None if model.visual_map is None else Ways(model.visual_map)
        self._parts = [] if self._ways is None else drives_of_map(model)
        self._goals = [] if self._ways is None else goals_of(model)

    def body(self) -> Iterator[str]:
        model, believed_on = self._model, self._believed()
        yield html.tiles(
            {
                "drives": str(len(model.names)),
                "frames": f"{sum(map(len, model.atoms)):,}",
                "goals": ", ".join(self._goals) or str(model.transitions.goals.size),
                "states": str(model.states),
                "shared by drives": str(len(self._graph.shared)),
                "states with reward": str(int((model.reward > 1e-6).sum())),
            }
        )
        yield from self._missing()
        yield "<h2>The taught ways</h2>"
        yield from self._map(believed_on)
        if self._ways is not None:
            yield "<h2>Cost to go</h2>"
            yield from self._costs(self._ways)
            yield "<h2>Where the belief was wide</h2>"
            yield from self._belief(self._ways, believed_on)
        yield "<h2>Reward</h2>"
        yield from self._reward()
        yield "<h2>States</h2>"
        yield from self._states()
        yield "<h2>The model</h2>"
        yield html.table(["of", "is"], facts(model, str(self._file), self._file.stat().st_size).items(), left=2)
        yield "<h3>Drives</h3>"
        yield self._drives()

    def _missing(self) -> Iterator[str]:
        if self._found is None:
            yield (
                '<p class="note" role="note"><b>Without images.</b> A model keeps features of images, and no image; '
                "<code>--recordings DIR</code> names the recordings that it was taught from.</p>"
            )
        elif self._found.missing:
            items = "".join(f"<li>{escape(line)}</li>" for line in self._found.missing)
            count = f"{len(self._found.missing)} of {len(self._names)} drives"
            yield f'<div class="note" role="note"><b>Missing:</b> {count}.<ul>{items}</ul></div>'

    def _map(self, believed_on: Mapping[int, Believed]) -> Iterator[str]:
        shared, forks = self._graph.shared, self._graph.forks
        of_states = (
            f"{self._model.states} states, each of {self._model.sequence_length} frames; {len(shared)} are shared by "
            f"drives, and at {len(forks)} the drives went on differently"
            f"{_listed(forks)}."
        )
        states = figures.draw_states(self._model, self._ways, self._parts, self._graph)
        if self._ways is None:
            yield "<p>There is no map of views: this model is for the paper's scheme alone.</p>"
            yield f'<div class="pair">{_figure(states, "states", "The states", of_states)}</div>'
            return
        partings = [
            f"{number}: {'fork' if one.fork else 'the ways meet'} {self._at(one.keyframe)}, with "
            f"{' and '.join(self._drive(d) for d in one.drives if d != self._ways.of[one.keyframe])}"
            for number, one in enumerate(self._ways.partings, 1)
        ]
        how = "by odometry" if self._ways.map.odometry else "as a schematic, since they are without odometry"
        said = f"{_counted(len(self._ways.map.goals), 'drive')} {how}."
        pictures = (
            _figure(figures.draw_ways(self._ways, self._goals, believed_on), "ways", "Where they run", said),
            _figure(states, "states", "The states on them", of_states),
        )
        yield f'<div class="pair">{"".join(pictures)}</div>'
        if partings:
            yield f"<ul>{''.join(f'<li>{escape(line)}</li>' for line in partings)}</ul>"
        elif len(self._ways.map.goals) > 1:
            yield "<p>Nowhere do shared ways part or meet.</p>"

    def _at(self, keyframe: int) -> str:
        assert self._ways is not None  # noqa: S101 - or there would be no keyframe
        way = float(self._ways.way[self._ways.map.keyframes[keyframe]])
        return f"{way:.1f} {figures.unit(self._ways)} along {self._drive(int(self._ways.of[keyframe]))}"

    def _drive(self, drive: int) -> str:
        """Name a drive of the map."""
        return episode_of(self._names[self._parts[drive][0]])

    def _costs(self, ways: Ways) -> Iterator[str]:
        names = [self._drive(drive) for drive in range(len(ways.map.goals))]
        pictures, rows, no_way = [], [], []
        for number, goal in enumerate(self._goals):
            costs, _ = cost_to_go(ways.map, goal)
            said = (
                f"Time to {escape(goal)} from each place of the drives, going over to another one where that is sooner."
            )
            drawn = figures.draw_cost_to_go(ways, costs, names)
            pictures.append(_figure(drawn, f"costs{number}", f"Cost to go to {goal}", said))
            for drive, name in enumerate(names):
                on = costs[ways.of == drive]
                where = np.round(np.array(_SHARES) * (on.size - 1)).astype(int)
                rows.append([goal, name, *(_seconds(seconds) for seconds in on[where].tolist())])
                if not np.isfinite(on).any():
                    no_way.append(f"No taught way leads from {name} to {goal}.")
        head = ["to", "on the drive", "start", *(f"{share:.0%}" for share in _SHARES[1:-1]), "end"]
        yield f'<div class="pair">{"".join(pictures)}</div>'
        yield from (f"<p>{escape(line)}</p>" for line in no_way)
        yield html.table(head, rows, left=2)

    def _believed(self) -> dict[int, Believed]:
        """Let recognition follow each drive of the map whose recording is there."""
        if self._ways is None:
            return {}
        whole: dict[int, list[Demonstration]] = {}
        for drive, numbers in enumerate(self._parts):
            parts = [one for one in (self._demonstrations[number] for number in numbers) if one is not None]
            if len(parts) == len(numbers):
                whole[drive] = parts
        total, done = sum(len(part.atoms) for parts in whole.values() for part in parts), 0

        def advance(frames: int) -> None:
            nonlocal done
            done += frames
            self._advance("recognizing", done, total)

        return {drive: believed(self._model, self._ways, drive, parts, advance) for drive, parts in whole.items()}

    def _belief(self, ways: Ways, believed_on: Mapping[int, Believed]) -> Iterator[str]:
        if not believed_on:
            yield "<p>Recognition was not run: none of the drives' recordings is there.</p>"
            return
        pictures, rows = [], []
        for drive, one in believed_on.items():
            wide = one.wide()
            tick_s = ways.map.tick_s
            where = ", ".join(f"{first * tick_s:.1f} to {last * tick_s:.1f} s" for first, last in wide) or "nowhere"
            drawn = figures.draw_belief(ways, drive, one)
            name = self._drive(drive)
            pictures.append(_figure(drawn, f"belief{drive}", name, f"Less likely there than not: {where}."))
            widest = int(one.spread.argmax())
            rows.append(
                [
                    name,
                    f"{np.median(one.here):.0%}",
                    f"{(one.here < 0.5).mean():.0%}",
                    f"{one.spread[widest]:.2f} {figures.unit(ways)} at {widest * tick_s:.1f} s",
                    f"{one.lost.max():.0%}",
                ]
            )
        yield (
            "<p>Recognition follows the drives that it was taught from once more. “Where it was” is the part of the "
            f"belief within {ways.map.correlation_length:.2f} {figures.unit(ways)} of the robot, the way over which "
            "views become half as alike; the belief is wide where that is less than half.</p>"
        )
        yield f'<div class="pair">{"".join(pictures)}</div>'
        yield html.table(
            ["drive", "where it was, median", "of the time wide", "largest spread", "lost, at most"], rows, left=1
        )

    def _reward(self) -> Iterator[str]:
        model = self._model
        best = np.argsort(-model.reward, kind="stable")
        rewarded = best[model.reward[best] > 1e-6].tolist()
        told = ", ".join(f"{state} ({model.reward[state]:.3g})" for state in rewarded[:_SHOWN])
        more = f" and {len(rewarded) - _SHOWN} more" if len(rewarded) > _SHOWN else ""
        text = (
            "<p>Ng and Russell's program looks for the reward under which the expert's actions win by the most. "
            f"It gave {len(rewarded)} of {model.states} states a reward{': ' if rewarded else ''}{told}{more}. "
            f"V is what is to be had from a state on, at a discount of {model.gamma:g}. Only the paper's scheme asks "
            "for it; the filter goes by the cost to go.</p>"
        )
        drawn = figures.draw_reward(model, self._names)
        said = "Of the state that each frame belongs to."
        yield f'<div class="pair">{_figure(drawn, "reward", "Reward and value along the drives", said)}{text}</div>'

    def _states(self) -> Iterator[str]:
        yield (
            "<p>By the drive that was the first to show them. Under each: the frames, what the policy does there "
            "(↑ ahead, ↰ left, ↱ right, ↓ back, ■ stop), its reward R and value V.</p>"
        )
        images = self._folder / "states"
        images.mkdir(exist_ok=True)
        done = 0
        for number, new in enumerate(first_seen(self._model)):
            if not new:
                continue
            one = self._demonstrations[number]
            pictured = one is not None and one.images is not None
            cards = []
            for state, first in new.items():
                picture = self._strip(images, one, state, first) if one is not None and pictured else ""
                cards.append(f"<figure>{picture}<figcaption>{self._caption(state, first)}</figcaption></figure>")
                done += 1
                self._advance("drawing", done, self._model.states)
            without = "" if pictured else " (without images: its recording is not there)"
            said = f"{self._names[number]}: {_counted(len(new), 'state')}{without}"
            opened = " open" if number == 0 else ""
            shown = f'<div class="states">{"".join(cards)}</div>'
            yield f"<details{opened}><summary>{escape(said)}</summary>{shown}</details>"

    def _strip(self, images: Path, one: Demonstration, state: int, first: int) -> str:
        """Write the frames of a state as one picture, and show it when it is looked at."""
        assert one.images is not None  # noqa: S101 - asked before
        frames = np.linspace(first, first + self._model.sequence_length - 1, min(_SHOWN, self._model.sequence_length))
        views = [shrunk(one.images[frame], _FRAME_PX) for frame in np.unique(frames.astype(int)).tolist()]
        gap = np.full((len(views[0]), _GAP_PX, 3), 128, np.uint8)
        strip: NDArray[np.uint8] = np.concatenate([part for view in views for part in (gap, view)][1:], axis=1)
        name = f"{state:05d}.jpg"
        (images / name).write_bytes(encode_jpeg(strip))
        height, width = strip.shape[:2]
        said = f"state {state}: {len(views)} of its frames"
        return f'<img loading="lazy" src="states/{name}" width="{width}" height="{height}" alt="{said}">'

    def _caption(self, state: int, first: int) -> str:
        model, last = self._model, first + self._model.sequence_length - 1
        marks = [f"frames {first} to {last}", action_of(model, state)]
        marks.append(f"R {model.reward[state]:.3g}, V {model.value[state]:.3g}")
        episodes, following = self._graph.episodes[state], self._graph.following[state]
        if state in model.transitions.goals:
            marks.append("goal")
        if len(episodes) > 1:
            marks.append(f"shared by {len(episodes)} drives")
        if len(following) > 1:
            marks.append(f"fork: goes on to {', '.join(map(str, following))}")
        return f"<b>State {state}</b> · " + " · ".join(mark for mark in marks if mark)

    def _drives(self) -> str:
        model, goal_of = self._model, dict[int, str]()
        if self._ways is not None:
            goal_of = {part: self._goals_of_drive(d) for d, parts in enumerate(self._parts) for part in parts}
        rows = []
        for number, name in enumerate(self._names):
            one = self._demonstrations[number]
            kind = "recovery" if model.recovery[number] else "drive"
            reached = "reached" if model.successful[number] else "not reached"
            recorded = "not there" if one is None else "there" if one.images is not None else "there, without images"
            frames, states = len(model.atoms[number]), len(set(model.state_streams[number].tolist()))
            rows.append([name, kind, goal_of.get(number, "-"), reached, recorded, f"{frames:,}", f"{states:,}"])
        return html.table(["name", "kind", "goal", "its end", "recording", "frames", "states"], rows, left=5)

    def _goals_of_drive(self, drive: int) -> str:
        return self._model.mapped.goals[drive]


def _figure(drawn: Figure, name: str, title: str, said: str) -> str:
    """Return a figure with its caption, which is HTML; the title is text."""
    return (
        f'<figure class="own"><h3>{escape(title)}</h3>{svg(drawn, name, title)}<figcaption>{said}</figcaption></figure>'
    )


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'s' * (count != 1)}"


def _seconds(seconds: float) -> str:
    return f"{seconds:.1f} s" if np.isfinite(seconds) else "no way"


def _listed(states: Sequence[int]) -> str:
    """Name some states."""
    if not states:
        return ""
    more = f" and {len(states) - 2 * _SHOWN} more" if len(states) > 2 * _SHOWN else ""
    return f" ({', '.join(map(str, states[: 2 * _SHOWN]))}{more})"
