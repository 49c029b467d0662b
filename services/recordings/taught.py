"""What the names of demonstrations say of the recordings that they were read from."""

from __future__ import annotations

import re
from collections.abc import Sequence


def episode_of(name: str) -> str:
    """Return the episode of a demonstration, which may be a piece of it."""
    return name.partition("[")[0]


def ticks_of(names: Sequence[str], frames: int) -> list[int]:
    """Return the ticks of a drive of so many frames that is made of pieces, each named ``episode[first-last]``.

    Empty where the names do not say, as that of a whole episode, or say something else than that many.
    """
    spans = [re.search(r"\[([0-9]{1,18})-([0-9]{1,18})\]$", name) for name in names]
    pieces = [range(int(span[1]), int(span[2]) + 1) for span in spans if span is not None]
    return [tick for piece in pieces for tick in piece] if sum(map(len, pieces)) == frames else []
