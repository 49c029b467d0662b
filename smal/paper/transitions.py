"""State transitions (paper, Algorithm 4): T(s, a, s') by counting the demonstrated pairs (s, a)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from smal.arrays import Floats, Int32s, Int64s

NO_ACTION = -1  # The action of a goal state.


@dataclass(frozen=True, eq=False)
class Transitions:
    """T as one row per demonstrated pair (s, a), p pairs.

    Pairs are sorted by state, then action. Only demonstrated pairs are transitions. A goal state has exactly one pair,
    with the action `NO_ACTION`, that stays there for ever. A state without any pair is a dead end: a demonstration
    stopped there without success, and no other passed through.
    """

    #: (p,) state and action of each pair.
    state: Int32s
    action: Int32s
    #: (p + 1,) successors of pair i are the entries offsets[i] to offsets[i + 1].
    offsets: Int64s
    #: (t,)
    next_state: Int32s
    #: (t,) number of times that pair i led to that state; 0 for a goal that stays.
    count: Int32s
    #: (t,) T(s, a, s'); sums to 1 over the successors of a pair.
    probability: Floats
    #: Last states of the successful demonstrations, ascending.
    goals: Int32s
    #: Number of states.
    states: int

    @property
    def sound(self) -> bool:
        """Whether its parts fit together; those of a file can be invalid."""
        whole = (self.state, self.action, self.offsets, self.next_state, self.count, self.goals)
        integers = all(part.ndim == 1 and part.dtype.kind == "i" for part in whole)
        if not integers or self.probability.ndim != 1:
            return False
        steps = np.diff(self.offsets)
        indices = (self.state, self.next_state, self.goals)
        return (
            len(self.state) == len(self.action) == len(steps)
            and len(self.next_state) == len(self.count) == len(self.probability)
            and self.offsets[0] == 0
            and self.offsets[-1] == len(self.next_state)
            and bool((steps >= 0).all())
            and bool((self.count >= 0).all())
            and bool((self.action >= NO_ACTION).all())
            and all(bool(((part >= 0) & (part < self.states)).all()) for part in indices)
            and bool(((self.probability >= 0.0) & (self.probability <= 1.0 + 1e-6)).all())
        )

    @property
    def pairs(self) -> int:
        """Number of demonstrated pairs."""
        return int(self.state.size)

    @property
    def matrix(self) -> sparse.csr_array:
        """T, sparse (pairs, states); rows sum to 1."""
        return sparse.csr_array(
            (self.probability, self.next_state, self.offsets), shape=(self.pairs, self.states)
        )

    @property
    def pair_counts(self) -> Int64s:
        """Number of demonstrations of each pair, (p,)."""
        return np.add.reduceat(self.count, self.offsets[:-1], dtype=np.int64)

    def by_preference(self) -> Int64s:
        """Return pairs sorted by state, and within a state by the expert's preference: leaving, frequent, lower number.

        When two successive sequences have one state, the first of their actions always leads from the state to itself.
        However frequent that is, the expert did leave the state. Therefore actions that never leave a state come last;
        otherwise the expert's policy is to stay for ever.
        """
        stays = np.asarray(self.matrix[np.arange(self.pairs), self.state]) >= 1.0
        return np.lexsort((self.action, -self.pair_counts, stays, self.state))

    def expert_pairs(self) -> Int64s:
        """Return the preferred pair of every state, or -1 for a dead end; (states,)."""
        order = self.by_preference()
        seen, first = np.unique(self.state[order], return_index=True)
        pairs = np.full(self.states, -1, dtype=np.int64)
        pairs[seen] = order[first]
        return pairs


def learn_transitions(
    state_streams: Sequence[Int32s],
    action_streams: Sequence[Int32s],
    successful: Sequence[bool],
    states: int,
) -> Transitions:
    """Count transitions in s-streams and a-streams, within each demonstration.

    The end of an unsuccessful demonstration (a recovery drive) is an ordinary state: its successor is unknown, so that
    it adds no pair. ValueError without a successful demonstration.
    """
    ends = [
        int(s[-1]) for s, good in zip(state_streams, successful, strict=True) if good and s.size
    ]
    if not ends:
        raise ValueError(
            "no successful demonstration has a whole sequence, so there is no goal to learn"
        )
    goals = np.unique(ends).astype(np.int32)
    now = np.concatenate([s[:-1] for s in state_streams])
    action = np.concatenate([a[:-1] for a in action_streams])
    then = np.concatenate([s[1:] for s in state_streams])
    # A goal ends the task, also if another demonstration passes it.
    going_on = ~np.isin(now, goals)
    moved = np.stack([now[going_on], action[going_on], then[going_on]], axis=1).astype(np.int32)
    stay = np.stack([goals, np.full_like(goals, NO_ACTION), goals], axis=1)
    distinct, often = np.unique(moved, axis=0, return_counts=True)
    triples = np.concatenate([distinct, stay])
    order = np.lexsort(triples.T[::-1])
    triples = triples[order]
    count = np.append(often, np.zeros(len(goals))).astype(np.int32)[order]
    pairs, first, size = np.unique(triples[:, :2], axis=0, return_index=True, return_counts=True)
    # A goal stays with certainty, with the count 0.
    share = np.maximum(count, 1)
    total = np.repeat(np.add.reduceat(share, first), size)
    return Transitions(
        state=pairs[:, 0].copy(),
        action=pairs[:, 1].copy(),
        offsets=np.append(first, len(triples)).astype(np.int64),
        next_state=triples[:, 2].copy(),
        count=count,
        probability=share / total,
        goals=goals,
        states=states,
    )
