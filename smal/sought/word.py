"""What a detector says of what is sought: the thing that it finds where drives end and nowhere else, and how surely.

The word of a detector is calibrated as the patches are (`smal.sought.learning`): by what it says in the approach, and
in views of the way. So nobody types in a threshold, and a detector that finds its thing everywhere says nothing.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from smal.arrays import AnyArray, Floats
from smal.features.detectors import LONGEST, Detection
from smal.sought.score import SCORES, Said


@dataclass(frozen=True, eq=False)
class Word:
    """What a detector finds at the end of the way, and what it says to find it."""

    label: str
    size: float  # Of its box where the ways ended, share of the view.
    log_ratio: Floats  # (201,) log p(score | in view) - log p(score | not) at `SCORES`, ascending.

    def __post_init__(self) -> None:
        """ValueError where parts do not fit together: they may come from a file."""
        label: object = self.label
        fits = self.log_ratio.shape == SCORES.shape and bool((np.abs(self.log_ratio) < 1e3).all())
        if not (
            isinstance(label, str) and len(label) <= LONGEST and 0.0 < self.size <= 1.0 and fits
        ):
            raise ValueError(
                f"the parts of what a detector says do not fit together: {str(label)[:LONGEST]!r}"
            )

    def says(self, detections: Iterable[Detection]) -> Said:
        """Return what is said by what is found in one view."""
        score, one = best(detections, self.label)
        if one is None:
            return Said(float(self.log_ratio[0]), 0.0, 0.0)
        left, _, right, _ = one.box
        near = math.sqrt(area(one) / self.size)
        middle = min(max((left + right) / 2.0, 0.0), 1.0)
        return Said(float(np.interp(score, SCORES, self.log_ratio)), near, 0.5 - middle)


def area(one: Detection) -> float:
    """Return how much of the view its box takes; nothing if its sides are in the wrong order."""
    left, top, right, bottom = one.box
    return max(right - left, 0.0) * max(bottom - top, 0.0)


def best(detections: Iterable[Detection], label: str) -> tuple[float, Detection | None]:
    """Return the highest score of what is found of a label, and of which detection that is."""
    scores = [(one.score, one) for one in detections if one.label == label]
    return max(scores, key=lambda each: each[0], default=(0.0, None))


def content_of_words(
    words: Mapping[str, Word],
) -> tuple[list[dict[str, Any]], dict[str, AnyArray]]:
    """Return what a file says of the words on goals, and the arrays in it."""
    said = [{"goal": goal, "label": one.label, "size": one.size} for goal, one in words.items()]
    return said, {f"word {number}": one.log_ratio for number, one in enumerate(words.values())}


def words_of_content(
    said: Sequence[dict[str, Any]], arrays: dict[str, AnyArray]
) -> dict[str, Word]:
    """Take the words on goals out of what a file says; LookupError, TypeError or ValueError where that is wrong."""
    return {
        str(one["goal"]): Word(one["label"], one["size"], arrays.pop(f"word {number}"))
        for number, one in enumerate(said)
    }
