"""Detections of the target: the label that a detector finds at the ends of drives and nowhere else.

The score of a detector is calibrated like the appearance (`smal.target.evidence`), on the approach
and on views of the way. A detector that finds its object everywhere gives no evidence.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

from smal.features.detectors import LONGEST, Detection
from smal.target.evidence import NOTHING, ScoreEvidence, Sighting

#: Relative error of the size of a box: a network's box can be cut by the edge of the view.
_SIZE_ERROR: Final = 0.1


@dataclass(frozen=True, eq=False)
class TargetLabel:
    """Label of the target, and the calibration of its score."""

    label: str
    #: Size of its box where the ways ended, as a share of the view.
    size: float
    evidence: ScoreEvidence

    def __post_init__(self) -> None:
        """Raise ValueError if the parts do not fit together: they can come from a file."""
        label: object = self.label
        named = isinstance(label, str) and len(label) <= LONGEST
        if not (named and 0.0 < self.size <= 1.0):
            raise ValueError(
                f"the parts of the detector's calibration do not fit together: {str(label)[:LONGEST]!r}"
            )

    def detect(self, detections: Iterable[Detection]) -> Sighting:
        """Return the evidence of the detections in one view."""
        score, detection = best(detections, self.label)
        log_ratio = self.evidence.log_ratio(score)
        if detection is None or area(detection) == 0.0:
            return NOTHING._replace(log_ratio=log_ratio)
        left, top, right, bottom = detection.box
        middle = min(max((left + right) / 2.0, 0.0), 1.0)
        log_near = math.log(area(detection) / self.size) / 2.0
        cut = top <= 0.0 or bottom >= 1.0
        return Sighting(log_ratio, log_near, _SIZE_ERROR, 0.5 - middle, cut)


def area(detection: Detection) -> float:
    """Return the area of the box as a share of the view; 0 if its sides are in the wrong order."""
    left, top, right, bottom = detection.box
    return max(right - left, 0.0) * max(bottom - top, 0.0)


def best(detections: Iterable[Detection], label: str) -> tuple[float, Detection | None]:
    """Return the highest score of a label, and its detection."""
    scores = [(found.score, found) for found in detections if found.label == label]
    return max(scores, key=lambda scored: scored[0], default=(0.0, None))


def content_of_labels(labels: Mapping[str, TargetLabel]) -> list[dict[str, Any]]:
    """Return the metadata of the labels of goals."""
    return [{"goal": goal} | asdict(label) for goal, label in labels.items()]


def labels_of_content(meta: Sequence[dict[str, Any]]) -> dict[str, TargetLabel]:
    """Build the labels of goals from a file; LookupError, TypeError or ValueError if the content is invalid."""
    return {
        str(part["goal"]): TargetLabel(
            part["label"], part["size"], ScoreEvidence(**part["evidence"])
        )
        for part in meta
    }
