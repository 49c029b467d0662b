"""Detections of the target: the label that a detector finds at the ends of drives and nowhere else.

The score of a detector is calibrated like patches (`smal.sought.learning`): on the approach, and on views of the way.
So there is no threshold to set by hand, and a detector that finds its object everywhere gives no evidence.
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
    """Label of the target, and the calibration of its score."""

    label: str
    #: Size of its box where the ways ended, as a share of the view.
    size: float
    #: (201,) log p(score | in view) - log p(score | not) at `SCORES`, ascending.
    log_ratio: Floats

    def __post_init__(self) -> None:
        """Raise ValueError if the parts do not fit together: they can come from a file."""
        label: object = self.label
        named = isinstance(label, str) and len(label) <= LONGEST
        table = self.log_ratio.shape == SCORES.shape and bool((np.abs(self.log_ratio) < 1e3).all())
        if not (named and 0.0 < self.size <= 1.0 and table):
            raise ValueError(
                f"the parts of the detector's calibration do not fit together: {str(label)[:LONGEST]!r}"
            )

    def says(self, detections: Iterable[Detection]) -> Said:
        """Return the evidence of the detections in one view."""
        score, detection = best(detections, self.label)
        if detection is None:
            return Said(float(self.log_ratio[0]), 0.0, 0.0)
        left, _, right, _ = detection.box
        near = math.sqrt(area(detection) / self.size)
        middle = min(max((left + right) / 2.0, 0.0), 1.0)
        log_ratio = float(np.interp(score, SCORES, self.log_ratio))
        return Said(log_ratio, near, 0.5 - middle)


def area(detection: Detection) -> float:
    """Return the area of the box as a share of the view; 0 if its sides are in the wrong order."""
    left, top, right, bottom = detection.box
    return max(right - left, 0.0) * max(bottom - top, 0.0)


def best(detections: Iterable[Detection], label: str) -> tuple[float, Detection | None]:
    """Return the highest score of a label, and its detection."""
    scores = [(found.score, found) for found in detections if found.label == label]
    return max(scores, key=lambda scored: scored[0], default=(0.0, None))


def content_of_words(
    words: Mapping[str, Word],
) -> tuple[list[dict[str, Any]], dict[str, AnyArray]]:
    """Return the metadata and the arrays of the words of goals."""
    meta = []
    arrays = dict[str, AnyArray]()
    for number, (goal, word) in enumerate(words.items()):
        meta.append({"goal": goal, "label": word.label, "size": word.size})
        arrays[f"word {number}"] = word.log_ratio
    return meta, arrays


def words_of_content(
    meta: Sequence[dict[str, Any]], arrays: dict[str, AnyArray]
) -> dict[str, Word]:
    """Build the words of goals from a file; LookupError, TypeError or ValueError if the content is invalid."""
    words = {}
    for number, part in enumerate(meta):
        log_ratio = arrays.pop(f"word {number}")
        words[str(part["goal"])] = Word(part["label"], part["size"], log_ratio)
    return words
