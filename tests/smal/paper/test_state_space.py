"""Algorithm 1, Eq. 8 and Eq. 9."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from smal.paper.novelty import Match, describe_match
from smal.paper.phase import matched_phase, phase
from smal.paper.state_matching import Solution, solve
from smal.paper.state_space import MemoryBoundError, StateSpace, learn_state_space
from tests.smal.worlds import corridor, unit

SIZE = 300
LENGTH = 5
LAMBDA = 0.1 * np.sqrt(5)
# Rough enough that neighbouring sequences are places of their own.
ROUGH = 0.9
VIEWS = corridor(60, SIZE, smooth=ROUGH)


def noisy(views: np.ndarray, seed: int, noise: float = 0.3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return unit(views + noise * unit(rng.standard_normal(views.shape))).astype(np.float32)


def learned(drives: list[np.ndarray], tau: float = 0.3, max_bytes: int | None = None) -> StateSpace:
    return learn_state_space(drives, LENGTH, (LAMBDA, LAMBDA), tau, max_bytes=max_bytes)


def test_sequence_weights_and_eq_9_by_hand() -> None:
    W = np.array([[1.0, -1.0], [0.0, 0.5], [0.0, 4.0]])
    solution = Solution(np.array([2, 3, 7]), W, (9, 2), 2, 1.0, 0.0, 1, True, np.array([0.3, 0.5]))
    assert solution.active_blocks.tolist() == [1, 3]
    assert solution.block_weights.tolist() == [2.5, 4.0]
    match = describe_match(solution, np.full((4, 9), 0.25), np.full((2, 4), 0.5))
    assert match.state == 3
    assert (match.score, match.total_weight, match.residual, match.agreement) == pytest.approx(
        (2.0, 3.25, 0.4, 0.5)
    )


def test_without_weights_there_is_no_state() -> None:
    solution = Solution(
        np.zeros(0, np.intp), np.zeros((0, 2)), (9, 2), 2, 1.0, 0.0, 1, True, np.ones(2)
    )
    assert solution.block_weights.size == 0
    assert describe_match(solution, np.zeros((1, 9)), np.ones((2, 1))) == Match(
        None, 0.0, 0.0, 1.0, 0.0
    )


@pytest.mark.parametrize("shift", [-2, 0, 1, 3])
def test_phase_of_a_pure_shift(shift: int) -> None:
    assert phase(np.eye(5, k=-shift)) == pytest.approx(4 + shift)


@given(hnp.arrays(np.float64, (4, 4), elements=st.floats(-1, 1)))
def test_phase_is_bounded(block: np.ndarray) -> None:
    assert 0.0 <= phase(block) <= 6.0


def test_phase_follows_a_moving_query() -> None:
    X = np.asfortranarray(VIEWS.T.astype(np.float32))
    for shift in (0, 1, 2):
        Y = np.asfortranarray(noisy(VIEWS[20 + shift : 25 + shift], 1).T)
        assert matched_phase(solve(X, Y, LENGTH, LAMBDA, LAMBDA), 4) == pytest.approx(
            4 + shift, abs=0.7
        )


def test_novelty_is_eq_8() -> None:
    assert Match(3, 0.5, 0.9, 0.4, 0.9).is_novel(tau=0.5)
    assert not Match(3, 0.51, 0.9, 0.4, 0.9).is_novel(tau=0.5)
    assert Match(None, 0.0, 0.0, 1.0, 0.0).is_novel(tau=0.0)


def test_a_repeated_drive_shares_its_states() -> None:
    space = learned([noisy(VIEWS, seed) for seed in range(3)])
    assert space.states == 12
    for stream in space.streams:
        assert stream.tolist() == list(range(12))


def test_unrelated_places_become_states() -> None:
    other = corridor(30, SIZE, seed=5, smooth=ROUGH).astype(np.float32)
    space = learned([noisy(VIEWS, 0), other])
    assert space.states == 12 + 6
    assert space.streams[1].tolist() == list(range(12, 18))


def test_sequences_end_with_the_demonstration() -> None:
    frames = noisy(VIEWS[:13], 0)
    seen: list[tuple[int, int]] = []
    space = learn_state_space(
        [frames, frames[:4]],
        LENGTH,
        (LAMBDA, LAMBDA),
        1e9,
        progress=lambda done, every: seen.append((done, every)),
    )
    np.testing.assert_array_equal(space.templates.T, frames[3:])
    assert [len(stream) for stream in space.streams] == [2, 0]
    assert seen == [(1, 2), (2, 2)]


def test_memory_bound() -> None:
    bound = 4 * SIZE * 20
    with pytest.raises(MemoryBoundError, match="MiB allowed"):
        learned([noisy(VIEWS, 0)], tau=1e9, max_bytes=bound)
    assert learned([noisy(VIEWS[:20], 0)], tau=1e9, max_bytes=bound).states == 4
