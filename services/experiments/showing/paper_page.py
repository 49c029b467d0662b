"""The page of a model of the paper's scheme: its states, their images, the reward."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from html import escape
from pathlib import Path
from typing import Final

import numpy as np

from schemas.codec import printable
from services.experiments import html
from services.experiments.showing import figures
from services.experiments.showing.drives import TaughtDrives, first_seen
from services.experiments.showing.parts import counted, figure, listed, missing, strip
from services.experiments.showing.states import StateGraph, action_of, state_graph
from services.experiments.showing.summary import facts
from smal.demonstration import Demonstration
from smal.paper.model import Model

#: Frames of a state that are shown, spread over it; states with reward that are named.
_SHOWN: Final = 5


class PaperPage:
    """Makes the page; parameters as of `write_page`."""

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

    def body(self) -> Iterator[str]:
        """Yield the page, part by part."""
        model = self._model
        yield html.tiles(
            {
                "drives": str(len(model.names)),
                "frames": f"{sum(map(len, model.atoms)):,}",
                "goal states": str(model.transitions.goals.size),
                "states": str(model.states),
                "shared by drives": str(len(self._graph.shared)),
                "states with reward": str(int((model.reward > 1e-6).sum())),
            }
        )
        yield from missing(self._found, len(self._names))
        yield "<h2>States</h2>"
        shared, forks = self._graph.shared, self._graph.forks
        of_states = (
            f"{model.states} states, each of {model.sequence_length} frames; {len(shared)} are shared by "
            f"drives, and at {len(forks)} the drives went on differently{listed(forks)}."
        )
        yield figure(figures.draw_states(model, self._graph), "states", "What follows what", of_states)
        yield from self._states()
        yield "<h2>Reward</h2>"
        yield from self._reward()
        yield "<h2>The model</h2>"
        yield html.table(["of", "is"], facts(model, str(self._file), self._file.stat().st_size).items(), left=2)
        yield "<h3>Drives</h3>"
        yield self._drives()

    def _reward(self) -> Iterator[str]:
        model = self._model
        best = np.argsort(-model.reward, kind="stable")
        rewarded = best[model.reward[best] > 1e-6].tolist()
        told = ", ".join(f"{state} ({model.reward[state]:.3g})" for state in rewarded[:_SHOWN])
        more = f" and {len(rewarded) - _SHOWN} more" if len(rewarded) > _SHOWN else ""
        text = (
            "<p>Ng and Russell's program looks for the reward under which the expert's actions win by the most. "
            f"It gave {len(rewarded)} of {model.states} states a reward{': ' if rewarded else ''}{told}{more}. "
            f"V is what is to be had from a state on, at a discount of {model.gamma:g}. The policy goes by it.</p>"
        )
        drawn = figures.draw_reward(model, self._names)
        said = "Of the state that each frame belongs to."
        yield f'<div class="pair">{figure(drawn, "reward", "Reward and value along the drives", said)}{text}</div>'

    def _states(self) -> Iterator[str]:
        yield (
            "<p>By the drive that was the first to show them. Under each: the frames, what the policy does there "
            "(↑ ahead, ↰ left, ↱ right, ↓ back, ■ stop), its reward R and value V.</p>"
        )
        done = 0
        for number, new in enumerate(first_seen(self._model)):
            if not new:
                continue
            one = self._demonstrations[number]
            pictured = one is not None and one.images is not None
            cards = []
            for state, first in new.items():
                picture = self._strip(one, state, first) if one is not None and pictured else ""
                cards.append(f"<figure>{picture}<figcaption>{self._caption(state, first)}</figcaption></figure>")
                done += 1
                self._advance("drawing", done, self._model.states)
            without = "" if pictured else " (without images: its recording is not there)"
            said = f"{self._names[number]}: {counted(len(new), 'state')}{without}"
            opened = " open" if number == 0 else ""
            shown = f'<div class="states">{"".join(cards)}</div>'
            yield f"<details{opened}><summary>{escape(said)}</summary>{shown}</details>"

    def _strip(self, one: Demonstration, state: int, first: int) -> str:
        assert one.images is not None  # noqa: S101 - asked before
        length = self._model.sequence_length
        frames = np.unique(np.linspace(first, first + length - 1, min(_SHOWN, length)).astype(int)).tolist()
        said = f"state {state}: {len(frames)} of its frames"
        return strip(self._folder / "states" / f"{state:05d}.jpg", [one.images[frame] for frame in frames], said)

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
        model = self._model
        rows = []
        for number, name in enumerate(self._names):
            one = self._demonstrations[number]
            kind = "recovery" if model.recovery[number] else "drive"
            reached = "reached" if model.successful[number] else "not reached"
            recorded = "not there" if one is None else "there" if one.images is not None else "there, without images"
            frames, states = len(model.atoms[number]), len(set(model.state_streams[number].tolist()))
            rows.append([name, kind, reached, recorded, f"{frames:,}", f"{states:,}"])
        return html.table(["name", "kind", "its end", "recording", "frames", "states"], rows, left=4)
