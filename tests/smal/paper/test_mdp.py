"""Algorithms 3 and 4, the reward program and the policy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from smal.movement import Atom
from smal.paper.action_space import following_atoms, learn_action_space
from smal.paper.policy import policy_iteration, policy_matrix
from smal.paper.reward import learn_reward
from smal.paper.transitions import NO_ACTION, Transitions, learn_transitions

GAMMA = 0.9


def int32(*values: int) -> np.ndarray:
    return np.array(values, dtype=np.int32)


def random_transitions(seed: int, states: int = 12, demonstrations: int = 6) -> Transitions:
    rng = np.random.default_rng(seed)
    streams = [
        rng.integers(0, states, rng.integers(2, 15)).astype(np.int32) for _ in range(demonstrations)
    ]
    actions = [rng.integers(0, 4, len(stream)).astype(np.int32) for stream in streams]
    successful = [True, *(rng.random(demonstrations - 1) < 0.5).tolist()]
    return learn_transitions(streams, actions, successful, states)


def test_action_follows_its_sequence() -> None:
    atoms = np.array([1, 1, 3, 3, 4, 1, 2], dtype=np.int8)  # frames 1-3 and 4-6 are the sequences
    after = following_atoms(atoms, 3)
    assert after.tolist() == [[3, 4, 1], [2, Atom.STOP, Atom.STOP]]


def test_action_space_has_no_duplicates() -> None:
    atoms = np.tile(np.array([1, 3], dtype=np.int8), 6)
    space = learn_action_space([atoms, atoms[:8]], 2)
    assert len(space.actions) == len(np.unique(space.actions, axis=0))
    assert [len(stream) for stream in space.streams] == [6, 4]
    for stream, whole in zip(space.streams, (atoms, atoms[:8]), strict=True):
        np.testing.assert_array_equal(space.actions[stream], following_atoms(whole, 2))


def test_frequencies_by_hand() -> None:
    streams = [int32(0, 1, 0, 2), int32(0, 2)]
    actions = [int32(5, 6, 5, 7), int32(5, 7)]
    T = learn_transitions(streams, actions, [True, True], 3)
    pairs = dict(
        zip(
            zip(T.state.tolist(), T.action.tolist(), strict=True),
            T.matrix.toarray().tolist(),
            strict=True,
        )
    )
    assert pairs == {
        (0, 5): pytest.approx([0, 1 / 3, 2 / 3]),
        (1, 6): [1, 0, 0],
        (2, NO_ACTION): [0, 0, 1],
    }
    assert T.goals.tolist() == [2]
    assert T.pair_counts.tolist() == [3, 1, 0]


def test_transitions_do_not_cross_demonstrations() -> None:
    T = learn_transitions([int32(0, 1), int32(2, 3)], [int32(0, 0), int32(0, 0)], [True, True], 4)
    assert T.matrix.toarray().tolist() == [[0, 1, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1], [0, 0, 0, 1]]


def test_recovery_ends_at_no_goal() -> None:
    T = learn_transitions(
        [int32(0, 1, 2), int32(3, 4)], [int32(0, 0, 0), int32(0, 0)], [True, False], 5
    )
    assert T.goals.tolist() == [2]
    assert 4 not in T.state
    assert T.expert_pairs()[4] == -1


def test_dwelling_expert_moves_on() -> None:
    T = learn_transitions([int32(0, 0, 0, 1)], [int32(3, 3, 4, 3)], [True], 2)
    assert T.action[T.expert_pairs()[0]] == 4


@settings(max_examples=40)
@given(seed=st.integers(0, 2**20))
def test_rows_sum_to_one(seed: int) -> None:
    T = random_transitions(seed)
    np.testing.assert_allclose(T.matrix.sum(axis=1), 1.0)
    assert len(np.unique(np.stack([T.state, T.action]), axis=1).T) == T.pairs
    assert (T.probability > 0).all()


@settings(max_examples=40)
@given(seed=st.integers(0, 2**20))
def test_policy_iteration_agrees_with_the_linear_program(seed: int) -> None:
    """The least V that no action improves: an independent solver of the same problem."""
    T = random_transitions(seed)
    reward = np.random.default_rng(seed).uniform(-1, 1, T.states)
    by_policy = policy_iteration(T, reward, GAMMA)
    of_pair = np.eye(T.states)[T.state]
    acts = np.isin(np.arange(T.states), T.state)
    least = linprog(
        np.ones(T.states),
        A_ub=GAMMA * T.matrix.toarray() - of_pair,
        b_ub=-reward[T.state],
        A_eq=np.eye(T.states)[~acts],
        b_eq=reward[~acts],
        bounds=(None, None),
    )
    np.testing.assert_allclose(by_policy.value, least.x, atol=1e-6)
    taken = {
        (s, a): k for k, (s, a) in enumerate(zip(T.state.tolist(), T.action.tolist(), strict=True))
    }
    pairs = [taken[s, a] for s, a in enumerate(by_policy.action.tolist()) if a != NO_ACTION]
    np.testing.assert_allclose(
        by_policy.value[T.state[pairs]],
        (reward[T.state] + GAMMA * (T.matrix @ least.x))[pairs],
        atol=1e-6,
    )
    assert (by_policy.action[T.goals] == NO_ACTION).all()
    seen = set(zip(T.state.tolist(), T.action.tolist(), strict=True))
    assert all((s, a) in seen for s, a in enumerate(by_policy.action.tolist()) if a != NO_ACTION)


@settings(max_examples=40)
@given(seed=st.integers(0, 2**20), sparsity=st.sampled_from([0.01, 0.1, 0.5]))
def test_expert_is_optimal_under_the_learned_reward(seed: int, sparsity: float) -> None:
    T = random_transitions(seed)
    learned = learn_reward(T, GAMMA, sparsity)
    assert np.abs(learned.state_reward).max() <= 1.0 + 1e-9
    expert = T.expert_pairs()
    system = np.eye(T.states) - GAMMA * policy_matrix(T, expert).toarray()
    value = np.linalg.solve(system, learned.state_reward)
    gain = T.matrix @ value
    assert (gain[expert[T.state]] >= gain - 1e-6).all()
    assert (gain[expert[expert >= 0]] >= -1e-6).all()
    np.testing.assert_allclose(
        policy_iteration(T, learned.state_reward, GAMMA).value, value, atol=1e-5
    )


def test_reward_is_at_the_goal() -> None:
    streams = [np.arange(s, 30, dtype=np.int32) for s in (0, 3, 8)]
    actions = [np.full(len(stream), 1, dtype=np.int32) for stream in streams]
    T = learn_transitions(streams, actions, [True] * 3, 30)
    reward = learn_reward(T, 0.95).state_reward
    assert np.flatnonzero(reward > 1e-6).tolist() == [29]
    assert (np.diff(policy_iteration(T, reward, 0.95).value) > 0).all()
