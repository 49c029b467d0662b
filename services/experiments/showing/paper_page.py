"""What the page of a model of the paper shows: its states, and the reward."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from schemas.codec import printable
from services.experiments import html
from services.experiments.showing import figures
from services.experiments.showing.summary import state_graph
from services.experiments.words import listed
from smal.paper.model import Model


def paper_page(model: Model) -> Iterator[str]:
    """Yield it as HTML."""
    graph = state_graph(model)
    yield "<h2>States</h2>"
    forks = f" ({listed([str(state) for state in graph.forks])})" if graph.forks else ""
    said = (
        f"{model.states} states, each of {model.sequence_length} frames; {len(graph.shared)} are shared by drives, and "
        f"at {len(graph.forks)} the drives went on differently{forks}."
    )
    yield html.titled(figures.draw_states(model, graph), "What follows what", said)
    yield "<h2>Reward</h2>"
    best = np.argsort(-model.reward, kind="stable")
    rewarded = best[model.reward[best] > 1e-6].tolist()
    told = listed([f"{state} ({model.reward[state]:.3g})" for state in rewarded])
    text = (
        "<p>Ng and Russell's program looks for the reward under which the expert's actions win by the most. "
        f"It gave {len(rewarded)} of {model.states} states a reward{': ' if rewarded else ''}{told}. "
        f"V is what is to be had from a state on, at a discount of {model.gamma:g}. The policy goes by it.</p>"
    )
    drawn = figures.draw_reward(model, [printable(name) for name in model.names])
    reward = html.titled(drawn, "Reward and value along the drives", "Of the state that each frame belongs to.")
    yield f'<div class="pair">{reward}{text}</div>'
