"""Algorithm 1, Eq. 8, Eq. 9, and the store of templates."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from smal.paper import state_space
from smal.paper.novelty import AgreementTest, Match, WeightTest, describe_match, neighbour_agreement, novelty_test
from smal.paper.phase import matched_phase, phase
from smal.paper.state_matching import Solution, solve
from smal.paper.state_space import StateSpace, learn_state_space
from smal.paper.template_store import MemoryBoundError, TemplateStore
from tests.smal.worlds import corridor, unit

SIZE, LENGTH, LAMBDA = 300, 5, 0.1 * np.sqrt(5)
# Rough enough that neighbouring sequences are places of their own.
ROUGH = 0.9
VIEWS = corridor(60, SIZE, smooth=ROUGH)


def noisy(views: np.ndarray, seed: int, noise: float = 0.3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return unit(views + noise * unit(rng.standard_normal(views.shape))).astype(np.float32)


def test_sequence_weights_and_eq_9_by_hand() -> None:
    W = np.array([[1.0, -1.0], [0.0, 0.5], [0.0, 4.0]])
    solution = Solution(np.array([2, 3, 7]), W, (9, 2), 2, 1.0, 0.0, 1, True, np.array([0.3, 0.5]))
    assert solution.active_blocks.tolist() == [1, 3]
    assert solution.block_weights.tolist() == [2.5, 4.0]
    match = describe_match(solution, lambda frames: np.full((frames.stop - frames.start, 2), 0.5), np.ones(2))
    assert match.state == 3
    assert (match.score, match.total_weight, match.residual, match.agreement) == pytest.approx((2.0, 3.25, 0.4, 0.5))


def test_without_weights_there_is_no_state() -> None:
    solution = Solution(np.zeros(0, np.intp), np.zeros((0, 2)), (9, 2), 2, 1.0, 0.0, 1, True, np.ones(2))
    assert solution.block_weights.size == 0
    assert describe_match(solution, lambda _: np.zeros((0, 2)), np.ones(2)) == Match(None, 0.0, 0.0, 1.0, 0.0)


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
        assert matched_phase(solve(X, Y, LENGTH, LAMBDA, LAMBDA), 4) == pytest.approx(4 + shift, abs=0.7)


def test_weight_test_is_eq_8() -> None:
    test = WeightTest(tau=0.5)
    assert test.is_novel(Match(3, 0.5, 0.9, 0.4, 0.9))
    assert not test.is_novel(Match(3, 0.51, 0.9, 0.4, 0.9))
    assert test.is_novel(Match(None, 0.0, 0.0, 1.0, 0.0))


def test_agreement_test() -> None:
    test = AgreementTest(max_residual=0.7, min_agreement=0.6)
    assert not test.is_novel(Match(3, 0.1, 0.9, 0.7, 0.6))
    assert test.is_novel(Match(3, 0.1, 0.9, 0.71, 0.6))
    assert test.is_novel(Match(3, 0.1, 0.9, 0.7, 0.59))
    assert test.is_novel(Match(None, 0.0, 0.0, 0.0, 1.0))


def test_tests_by_name() -> None:
    assert novelty_test("weight", {"tau": 0.3}) == WeightTest(0.3)
    with pytest.raises(ValueError, match="unknown novelty"):
        novelty_test("other", {})
    with pytest.raises(ValueError, match="no such parameter"):
        novelty_test("weight", {"sigma": 1.0})


@pytest.mark.parametrize("test", [WeightTest(0.3), AgreementTest()])
def test_a_repeated_drive_shares_its_states(test: WeightTest | AgreementTest) -> None:
    space = learn_state_space([noisy(VIEWS, seed) for seed in range(3)], LENGTH, LAMBDA, LAMBDA, test)
    assert space.states == 12
    for stream in space.streams:
        assert stream.tolist() == list(range(12))


def test_unrelated_places_become_states() -> None:
    other = corridor(30, SIZE, seed=5, smooth=ROUGH).astype(np.float32)
    space = learn_state_space([noisy(VIEWS, 0), other], LENGTH, LAMBDA, LAMBDA, AgreementTest())
    assert space.states == 12 + 6
    assert space.streams[1].tolist() == list(range(12, 18))


def test_batches_do_not_change_the_result(monkeypatch: pytest.MonkeyPatch) -> None:
    """40 sequences, some of which are states that others of the same batch show."""
    frames = noisy(np.concatenate([VIEWS, VIEWS, corridor(80, SIZE, seed=3)]), 2)

    def learned() -> StateSpace:
        return learn_state_space([frames[:150], frames[150:]], LENGTH, LAMBDA, LAMBDA, AgreementTest())

    together = learned()
    monkeypatch.setattr(state_space, "_BATCH", 1)
    one_by_one = learned()
    assert together.states < 40
    for stream, other in zip(together.streams, one_by_one.streams, strict=True):
        assert stream.tolist() == other.tolist()
    np.testing.assert_array_equal(together.templates, one_by_one.templates)


def test_sequences_end_with_the_demonstration() -> None:
    frames = noisy(VIEWS[:13], 0)
    seen: list[tuple[int, int]] = []
    space = learn_state_space(
        [frames, frames[:4]],
        LENGTH,
        LAMBDA,
        LAMBDA,
        WeightTest(1e9),
        progress=lambda done, all_: seen.append((done, all_)),
    )
    np.testing.assert_array_equal(space.templates.T, frames[3:])
    assert [len(stream) for stream in space.streams] == [2, 0]
    assert seen == [(2, 2)]


def test_nothing_to_learn_is_refused() -> None:
    with pytest.raises(ValueError, match="5 frames"):
        learn_state_space([VIEWS[:4].astype(np.float32)], LENGTH, LAMBDA, LAMBDA, WeightTest())


def test_store_keeps_templates_and_gram() -> None:
    frames = noisy(np.concatenate([VIEWS, VIEWS, VIEWS]), 0)
    store = TemplateStore(SIZE)
    for start in range(0, len(frames), LENGTH):
        block = frames[start : start + LENGTH]
        store.append(block, store.templates.T @ block.T)
    np.testing.assert_array_equal(store.templates, frames.T)
    np.testing.assert_allclose(store.gram, frames @ frames.T, atol=1e-5)
    assert store.templates.flags.f_contiguous


def test_memory_bound() -> None:
    bound = TemplateStore.bytes_for(SIZE, 20)
    with pytest.raises(MemoryBoundError, match="MiB allowed"):
        learn_state_space([noisy(VIEWS, 0)], LENGTH, LAMBDA, LAMBDA, WeightTest(1e9), max_bytes=bound)
    enough = learn_state_space([noisy(VIEWS[:20], 0)], LENGTH, LAMBDA, LAMBDA, WeightTest(1e9), max_bytes=bound)
    assert enough.states == 4


def test_neighbour_agreement_is_that_of_moving_frames_only() -> None:
    views = VIEWS[:40].astype(np.float32)
    still = np.repeat(views[:1], 60, axis=0)
    moving = [np.ones(40, dtype=bool), np.zeros(60, dtype=bool)]
    measured = neighbour_agreement([views, still], moving)
    cosines = (views[:-1] * views[1:]).sum(axis=1)
    assert measured == pytest.approx(np.quantile(cosines, 0.75))
    with pytest.raises(ValueError, match="move"):
        neighbour_agreement([still], moving[1:])


@pytest.mark.parametrize("times", [2, 3])
def test_repeated_frames_are_no_neighbours(times: int) -> None:
    """As of a camera slower than the ticks; float32 products of equal views may exceed 1."""
    views = VIEWS[:40].astype(np.float32)
    repeated = np.repeat(views, times, axis=0)
    everywhere = [np.ones(40 * times, dtype=bool)]
    expected = neighbour_agreement([views], [np.ones(40, dtype=bool)])
    assert neighbour_agreement([repeated], everywhere) == pytest.approx(expected)
    with pytest.raises(ValueError, match="does not change"):
        neighbour_agreement([np.repeat(views[:1], 9, axis=0)], [np.ones(9, dtype=bool)])
