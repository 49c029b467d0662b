"""Conversion of the filter's belief to messages and back."""

import math
from typing import Any

import numpy as np

from schemas.array import Float32Array
from schemas.state import FAR_M, State
from smal.filter import Belief
from smal.robot import Located
from smal.target.detector import TargetEstimate


def fields_of(located: Located) -> dict[str, Any]:
    """Return the belief and the detected target as fields of `State`."""
    belief = located.belief
    offsets = belief.offsets.clip(-FAR_M, FAR_M)
    places = np.column_stack([belief.keyframes, offsets, belief.weights])
    fields: dict[str, Any] = {
        "status": "unknown" if belief.is_lost else "recognized",
        "places": Float32Array.from_numpy(places.astype(np.float32)),
        "lost": min(belief.lost, 1.0),
        "cosine": belief.cosine,
        "tracked_m": belief.tracked,
        "evidence": belief.evidence,
        "unseen_m": belief.unseen,
        "support": min(belief.support, 1e9),
        "camera": belief.camera,
        "pitch_deg": belief.pitch_deg,
        "moved_m": belief.moved,
    }
    if located.target is not None:
        fields |= dict(zip(("seen", "near", "seen_left"), located.target, strict=True))
    if math.isfinite(located.unexpected_ground):
        fields["strange_m"] = located.unexpected_ground
    return fields


def belief_of(state: State) -> Belief:
    """Return the belief of a state."""
    rows = state.places.to_numpy().astype(np.float64)
    return Belief(
        keyframes=state.keyframes,
        offsets=rows[:, 1:4],
        weights=rows[:, 4],
        lost=state.lost,
        cosine=state.cosine,
        tracked=state.tracked_m,
        evidence=state.evidence,
        unseen=state.unseen_m,
        camera=state.camera,
        pitch_deg=state.pitch_deg,
        moved=state.moved_m,
        support=math.inf if state.support is None else state.support,
    )


def target_of(state: State) -> TargetEstimate | None:
    """Return the detection of the target; None without a target detector."""
    if state.seen is None:
        return None
    return TargetEstimate(state.seen, state.near, state.seen_left)
