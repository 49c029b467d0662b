"""Template sequences against their definition, frame by frame."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from smal.place_recognition.template_sequences import SPEEDS, TemplateSequences


def frames_of(speed: float, end: int, length: int) -> list[int]:
    """Return the frames of one sequence, as the docstring of `TemplateSequences` has them."""
    return [end - math.floor(speed * (length - 1 - i) + 0.5) for i in range(length)]


@given(st.integers(1, 12), st.integers(1, 40), st.lists(st.floats(0.1, 5.0), min_size=1, max_size=6))
@settings(max_examples=60, deadline=None)
def test_frames_are_those_of_the_definition(length: int, references: int, speeds: list[float]) -> None:
    sequences = TemplateSequences(length, tuple(speeds))
    numbers = np.arange(len(speeds) * references)
    expected = [frames_of(speed, end, length) for speed in speeds for end in range(references)]
    assert sequences.frames(numbers, references).tolist() == expected
    assert all(frames[-1] == end for frames, end in zip(expected, list(range(references)) * len(speeds), strict=True))


@given(st.integers(0, 2**32 - 1), st.integers(1, 12), st.integers(1, 40))
@settings(max_examples=60, deadline=None)
def test_means_are_those_of_a_plain_loop(seed: int, length: int, references: int) -> None:
    """Also where windows begin before the first reference: there is no sequence."""
    products = np.random.default_rng(seed).normal(size=(length, references)).astype(np.float32)
    means = TemplateSequences(length).means(products)
    assert means.shape == (len(SPEEDS), references)
    for place, speed in enumerate(SPEEDS):
        for end in range(references):
            frames = frames_of(speed, end, length)
            if frames[0] < 0:
                assert means[place, end] == -np.inf
            else:
                expected = np.mean([products[i, frame] for i, frame in enumerate(frames)], dtype=np.float64)
                assert means[place, end] == pytest.approx(expected, abs=1e-5)


def test_the_first_windows() -> None:
    means = TemplateSequences(3, (0.5, 1.0, 2.0)).means(np.zeros((3, 6), dtype=np.float32))
    assert np.isfinite(means).tolist() == [
        [end >= 1 for end in range(6)],
        [end >= 2 for end in range(6)],
        [end >= 4 for end in range(6)],
    ]


def test_at_half_speed_every_second_query_advances() -> None:
    (back,) = TemplateSequences(10, (0.5,)).back
    assert back.tolist() == [5, 4, 4, 3, 3, 2, 2, 1, 1, 0]


def test_speeds_are_from_half_to_twice() -> None:
    assert (SPEEDS[0], SPEEDS[len(SPEEDS) // 2], SPEEDS[-1]) == (0.5, 1.0, 2.0)
    assert TemplateSequences(5).octaves == pytest.approx(np.linspace(-1, 1, len(SPEEDS)))


@pytest.mark.parametrize("speeds", [(), (0.0,), (-1.0,), (float("nan"),), (1.0, float("inf"))])
def test_bad_speeds_are_refused(speeds: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="speeds must be finite and positive"):
        TemplateSequences(3, speeds)


def test_a_sequence_has_a_frame() -> None:
    with pytest.raises(ValueError, match="at least 1 frame, got 0"):
        TemplateSequences(0)
