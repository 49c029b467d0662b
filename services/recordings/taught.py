"""What a model says of the recordings that it was learned from: it has the names of demonstrations, in order."""

from __future__ import annotations

import re
from collections.abc import Sequence

from smal.model import Model


def episode_of(name: str) -> str:
    """Return the episode of a demonstration, which may be a piece of it."""
    return name.partition("[")[0]


def ticks_of(name: str, frames: int) -> range:
    """Return the ticks of a demonstration that is a piece, ``episode[first-last]``; none of a whole one."""
    span = re.search(r"\[([0-9]{1,18})-[0-9]+\]$", name)
    return range(0) if span is None else range(int(span[1]), int(span[1]) + frames)


def drives_of_map(model: Model) -> list[tuple[int, ...]]:
    """Return which demonstrations of a model each drive of its map is made of, in order.

    A model does not say so. Those that reached the goal and had images are in its map, each with its parts, or with the
    last one alone where odometry was lost between them (`smal.learning`).
    """
    episodes: dict[str, list[int]] = {}
    for number, name in enumerate(model.names):
        episodes.setdefault(episode_of(name), []).append(number)
    whole = iter([parts for parts in episodes.values() if model.successful[parts[-1]]])
    found: list[tuple[int, ...]] = []
    for drive in range(len(model.mapped.goals)):
        frames = int((model.mapped.drives == drive).sum())
        for parts in whole:
            made_of = next((some for some in (parts, parts[-1:]) if _frames(model, some) == frames), None)
            if made_of is not None:
                found.append(tuple(made_of))
                break
        else:
            found.append(())
    return found


def _frames(model: Model, parts: Sequence[int]) -> int:
    return sum(len(model.atoms[part]) for part in parts)
