"""State transitions (paper, Algorithm 4): T(s, a, s') by counting, over the pairs (s, a) that were seen."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from smal.arrays import Floats, Int32s, Int64s

NO_ACTION = -1  # The action of a goal state: there is nothing left to do.


@dataclass(frozen=True, eq=False)
class Transitions:
    """T as one row per seen pair (s, a), p pairs.

    Pairs are sorted by state, then action. A pair that was never seen is not a transition. A goal state has exactly one
    pair, with the action `NO_ACTION`, that stays there for ever. A state without any pair is a dead end: a
    demonstration stopped there without success and no other passed through.
    """

    state: Int32s  # (p,) with the action the pairs.
    action: Int32s
    offsets: Int64s  # (p + 1,) successors of pair i are the entries offsets[i] to offsets[i + 1].
    next_state: Int32s  # (t,)
    count: Int32s  # (t,) how often pair i led to that state; 0 for a goal that stays.
    probability: Floats  # (t,) T(s, a, s'); sums to 1 over the successors of a pair.
    goals: Int32s  # Last states of the successful demonstrations, ascending.
    states: int  # Number of states.

    @property
    def sound(self) -> bool:
        """Whether its parts fit together, as those of a file need not."""
        whole = (self.state, self.action, self.offsets, self.next_state, self.count, self.goals)
        if (
            any(part.ndim != 1 or part.dtype.kind != "i" for part in whole)
            or self.probability.ndim != 1
        ):
            return False
        states = self.states
        steps = np.diff(self.offsets)
        return (
            len(self.state) == len(self.action) == len(steps)
            and len(self.next_state) == len(self.count) == len(self.probability)
            and self.offsets[0] == 0
            and self.offsets[-1] == len(self.next_state)
            and bool(
                (steps >= 0).all() and (self.count >= 0).all() and (self.action >= NO_ACTION).all()
            )
            and all(
                bool(((part >= 0) & (part < states)).all())
                for part in (self.state, self.next_state, self.goals)
            )
            and bool(((self.probability >= 0.0) & (self.probability <= 1.0 + 1e-6)).all())
        )

    @property
    def pairs(self) -> int:
        """Number of seen pairs."""
        return int(self.state.size)

    @property
    def matrix(self) -> sparse.csr_array:
        """T, sparse (pairs, states), rows sum to 1."""
        return sparse.csr_array(
            (self.probability, self.next_state, self.offsets), shape=(self.pairs, self.states)
        )

    @property
    def pair_counts(self) -> Int64s:
        """How often each pair was seen, (p,)."""
        return np.add.reduceat(self.count, self.offsets[:-1], dtype=np.int64)

    def by_preference(self) -> Int64s:
        """Pairs sorted by state, and within a state by what the expert did: moving on, often, lower number.

        When two sequences in a row fall on one state, the first of their actions always leads from the state to
        itself. However often that happened, the expert did leave the state: among the actions of a state, those
        that never leave it come last, or the expert's policy would be to stay for ever.
        """
        stays = np.asarray(self.matrix[np.arange(self.pairs), self.state]) >= 1.0
        return np.lexsort((self.action, -self.pair_counts, stays, self.state))

    def expert_pairs(self) -> Int64s:
        """Preferred pair of every state, or -1 for a dead end; (states,)."""
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
    """Count what followed what in s-streams and a-streams, never across two demonstrations.

    The end of a demonstration that was not successful (a recovery drive) is an ordinary state: nothing is known of what
    follows its last sequence, so that it adds no pair. Without a successful one ValueError is raised.
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
    going_on = ~np.isin(
        now, goals
    )  # A goal ends the task, also where another demonstration passes.
    moved = np.stack([now[going_on], action[going_on], then[going_on]], axis=1).astype(np.int32)
    stay = np.stack([goals, np.full_like(goals, NO_ACTION), goals], axis=1)
    distinct, often = np.unique(moved, axis=0, return_counts=True)
    triples = np.concatenate([distinct, stay])
    order = np.lexsort(triples.T[::-1])
    triples = triples[order]
    count = np.append(often, np.zeros(len(goals))).astype(np.int32)[order]
    pairs, first, size = np.unique(triples[:, :2], axis=0, return_index=True, return_counts=True)
    share = np.maximum(count, 1)  # a goal stays with certainty though it was never counted
    return Transitions(
        pairs[:, 0].copy(),
        pairs[:, 1].copy(),
        np.append(first, len(triples)).astype(np.int64),
        triples[:, 2].copy(),
        count,
        share / np.repeat(np.add.reduceat(share, first), size),
        goals,
        states,
    )
