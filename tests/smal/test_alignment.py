"""Where in the demonstrations a query is, to the frame."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from smal.alignment import (
    CONCENTRATION,
    REACH,
    RECENCY_TICKS,
    Columns,
    Correlate,
    DemonstratedOrder,
    aligned_phases,
    recency,
    relative_likelihood,
)
from tests.smal.worlds import corridor, unit

LENGTH = 5
# Two drives of 30 frames and one of 10, each sequence a state of its own.
LENGTHS = (30, 30, 10)
STREAMS = [np.arange(6), 6 + np.arange(6), 12 + np.arange(2)]
PHASES = [np.full(len(stream), LENGTH - 1.0) for stream in STREAMS]
ALIKE = np.ones(LENGTH)
TEMPLATES = unit(np.random.default_rng(0).standard_normal((sum(LENGTHS), 40)))


def correlations_with(query: np.ndarray) -> Correlate:
    products = TEMPLATES @ query.T

    def correlate(columns: Columns) -> np.ndarray:
        values: np.ndarray = products[columns, np.arange(len(query))]
        return values

    return correlate


@settings(deadline=None)
@given(
    drive=st.integers(0, 1),
    last=st.integers(LENGTH + 1, 28),
    off=st.integers(-REACH, REACH),
    q=st.integers(1, 2 * LENGTH),
)
def test_a_demonstrated_window_is_found_wherever_it_ends(drive: int, last: int, off: int, q: int) -> None:
    start = sum(LENGTHS[:drive])
    q = min(q, last + 1)
    query = TEMPLATES[start + last - q + 1 : start + last + 1]
    number = min(last // LENGTH, 5)
    true = last - number * LENGTH
    found = DemonstratedOrder(STREAMS, PHASES, LENGTH).align(
        [STREAMS[drive][number]], [float(true + off)], recency(q, RECENCY_TICKS), correlations_with(query)
    )
    assert found.phases.tolist() == [true]


@given(seed=st.integers(0, 99))
def test_no_window_spans_two_drives(seed: int) -> None:
    query = unit(np.random.default_rng(seed).standard_normal((LENGTH, 40)))
    order = DemonstratedOrder(STREAMS, PHASES, LENGTH)
    # The last sequence of the first drive and the first one of the second drive, which are neighbours in X.
    last, first = order.align([5, 6], [4.0, 2.0], ALIKE, correlations_with(query)).phases
    assert 4 - REACH <= last <= 4
    assert 0 <= first <= 2 + REACH


def test_a_phase_stays_where_nothing_was_demonstrated_within_reach() -> None:
    order = DemonstratedOrder(STREAMS, PHASES, LENGTH)
    found = order.align([13, 0], [30.5, -20.0], ALIKE[:3], correlations_with(TEMPLATES[:3]))
    assert found.phases.tolist() == [30.5, -20.0]


def test_of_equally_good_phases_the_nearest_is_taken() -> None:
    order = DemonstratedOrder(STREAMS, PHASES, LENGTH)
    found = order.align([2], [3.2], ALIKE, lambda columns: np.ones(columns.shape))
    assert found.phases.tolist() == [3.0]


def test_similarity_and_likelihood() -> None:
    query = 0.8 * TEMPLATES[10:15] + 0.6 * TEMPLATES[40:45]
    found = DemonstratedOrder(STREAMS, PHASES, LENGTH).align(
        [2, 8, 13], [4.0, 4.0, 40.0], recency(LENGTH, RECENCY_TICKS), correlations_with(query)
    )
    weights = np.exp(-np.arange(LENGTH)[::-1] / RECENCY_TICKS)
    for number, start in ((0, 10), (1, 40)):
        products = np.einsum("qm,qm->q", query, TEMPLATES[start : start + LENGTH])
        assert found.similarity[number] == pytest.approx(np.average(products, weights=weights))
    assert found.similarity[2] == -np.inf
    odds = relative_likelihood(found.similarity)
    assert odds[0] == 1.0
    assert odds[1] == pytest.approx(np.exp(CONCENTRATION * (found.similarity[1] - found.similarity[0])))
    assert odds[2] == 0.0
    assert relative_likelihood(np.array([-np.inf, -np.inf])).tolist() == [1.0, 1.0]


def test_recent_frames_decide() -> None:
    # Old frames of one place, the last ones of another, both within reach of the phase.
    query = np.concatenate([TEMPLATES[8:11], TEMPLATES[14:16]])
    order = DemonstratedOrder(STREAMS, PHASES, LENGTH)
    recent = order.align([2], [3.0], recency(LENGTH, 1.0), correlations_with(query))
    alike = order.align([2], [3.0], ALIKE, correlations_with(query))
    assert recent.phases.tolist() == [15 - 10]
    assert alike.phases.tolist() == [12 - 10]


def test_hidden_frames_have_no_say() -> None:
    """The last two show another place, as something in front of the camera may."""
    query = np.concatenate([TEMPLATES[11:14], TEMPLATES[40:42]])
    weights = ALIKE * [1, 1, 1, 0, 0]
    found = DemonstratedOrder(STREAMS, PHASES, LENGTH).align([2], [3.0], weights, correlations_with(query))
    assert found.phases.tolist() == [15 - 10]
    assert found.similarity[0] == pytest.approx(1.0)


@pytest.mark.parametrize("late", [-3, -1, 0, 2, 4])
def test_sequences_of_a_second_drive_are_aligned_with_the_first(late: int) -> None:
    views = corridor(60, 150, 1)
    rng = np.random.default_rng(late + 5)
    first, second = (
        unit(part + 0.2 * unit(rng.standard_normal(part.shape))).astype(np.float32)
        for part in (views[10:40], views[10 + late : 40 + late])
    )
    streams = [np.arange(6, dtype=np.int32)] * 2
    rough = [np.full(6, 4.0, dtype=np.float32)] * 2
    found = aligned_phases(np.asfortranarray(first.T), streams, rough, [first, second], LENGTH)
    assert found[0].tolist() == [4.0] * 6
    # At the ends the drives do not overlap.
    assert found[1][1:-1].tolist() == [4.0 + late] * 4
