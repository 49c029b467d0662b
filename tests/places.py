"""Beliefs for tests."""

import numpy as np

from schemas.array import Float32Array
from schemas.state import State
from smal.model import Model
from tests import corridor

Row = tuple[float, float, float, float, float]


def places(*rows: Row) -> Float32Array:
    """Return places of `State`: keyframe, ahead_m, left_m, turned_rad, weight."""
    return Float32Array.from_numpy(np.array(rows, np.float32).reshape(-1, 5))


def estimate(state: State, model: Model | None = None) -> tuple[float, float]:
    """Return how far along the corridor a state's likeliest place is, and how far left of its middle."""
    keyframe, ahead, left = state.places.to_numpy()[0, :3]
    at = (model or corridor.model()).mapped.key_poses[int(keyframe), 0]
    return float(at + ahead), float(left)
