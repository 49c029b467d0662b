"""What a model says of the recordings that it was learned from: it has the names of demonstrations, in order."""

from __future__ import annotations

import re

from smal.paper.model import Model


def episode_of(name: str) -> str:
    """Return the episode of a demonstration, which may be a piece of it."""
    return name.partition("[")[0]


def ticks_of(name: str, frames: int) -> range:
    """Return the ticks of a demonstration that is a piece, ``episode[first-last]``; none of a whole one."""
    span = re.search(r"\[([0-9]{1,18})-[0-9]+\]$", name)
    return range(0) if span is None else range(int(span[1]), int(span[1]) + frames)


def drives_of_map(model: Model) -> list[tuple[int, ...]]:
    """Return which demonstrations of a model each drive of its map is made of, in order."""
    return [tuple(model.names.index(name) for name in names) for names in model.mapped.names]
