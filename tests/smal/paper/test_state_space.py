"""Algorithm 1, Eq. 8 and Eq. 9."""

import numpy as np
import pytest

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


def test_repeated_drive_shares_its_states() -> None:
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
