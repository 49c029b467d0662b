"""Policy (Eq. 13): maximize the discounted reward over the actions that were demonstrated in a state."""

from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve

from smal.arrays import Floats, Int32s, Int64s
from smal.paper.transitions import NO_ACTION, Transitions

_TIE = 1e-9  # Relative difference of values below which actions are tied.
_MAX_ITERATIONS = 100_000


class Policy(NamedTuple):
    """The action of every state (states,), `NO_ACTION` in goal states and dead ends, and V (states,)."""

    action: Int32s
    value: Floats


def check_discount(gamma: float) -> None:
    """Raise ValueError for a discount factor outside [0, 1): with 1 the value of a goal is infinite."""
    if not 0.0 <= gamma < 1.0:
        raise ValueError(f"gamma must be at least 0 and below 1, got {gamma}")


def _best_pairs(transitions: Transitions, pair_values: Floats) -> Int64s:
    """Return the best pair of every state, or -1; the expert's preference breaks ties."""
    states, first, size = np.unique(transitions.state, return_index=True, return_counts=True)
    best = np.repeat(np.maximum.reduceat(pair_values, first), size)
    margin = _TIE * max(1.0, float(np.abs(pair_values).max()))
    tied = pair_values >= best - margin
    order = transitions.by_preference()
    order = order[np.lexsort((~tied[order], transitions.state[order]))]
    pairs = np.full(transitions.states, -1, dtype=np.int64)
    pairs[states] = order[first]
    return pairs


def policy_matrix(transitions: Transitions, pairs: Int64s) -> sparse.csr_array:
    """Return P of a policy given as one pair per state (-1: dead end, an empty row), sparse (states, states)."""
    chosen = np.flatnonzero(pairs >= 0)
    shape = transitions.states, transitions.pairs
    choose = sparse.csr_array((np.ones(chosen.size), (chosen, pairs[chosen])), shape=shape)
    return sparse.csr_array(choose @ transitions.matrix)


def policy_iteration(transitions: Transitions, reward: Floats, gamma: float) -> Policy:
    """Run Howard's policy iteration for R (states,) and 0 <= gamma < 1 (else ValueError) until it is optimal."""
    check_discount(gamma)
    pairs = transitions.expert_pairs()
    identity = sparse.eye_array(transitions.states, format="csc")
    for _ in range(_MAX_ITERATIONS):
        system = sparse.csc_array(identity - gamma * policy_matrix(transitions, pairs))
        value = np.asarray(spsolve(system, reward), dtype=np.float64)
        pair_values = reward[transitions.state] + gamma * (transitions.matrix @ value)
        best = _best_pairs(transitions, pair_values)
        # Only a real improvement changes a state's action: ties must not cause cycles.
        margin = _TIE * max(1.0, float(np.abs(value).max()))
        better = (pair_values[best] - value > margin) & (pairs >= 0)
        if not better.any():
            action = np.where(best >= 0, transitions.action[best], NO_ACTION)
            return Policy(action.astype(np.int32), value)
        pairs = np.where(better, best, pairs)
    raise RuntimeError(f"policy iteration did not end within {_MAX_ITERATIONS} improvements")
