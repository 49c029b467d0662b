"""LDB: against its definition cell by cell, and what leaves its signs alone."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from smal.features import modality_named
from smal.features.ldb import GRIDS, SIDE, SIZE

describe = modality_named("ldb").describe


def picture_of(seed: int, darkest: int = 0, brightest: int = 255, blocks: int = 10) -> np.ndarray:
    cells = np.random.default_rng(seed).integers(darkest, brightest + 1, (blocks, blocks), dtype=np.uint8)
    return np.repeat(np.kron(cells, np.ones((SIDE // blocks,) * 2, dtype=np.uint8))[:, :, None], 3, axis=2)


def slow_signs(grey: np.ndarray) -> np.ndarray:
    """Compare the means of cells and of their halves, one after the other, as the paper says it."""
    signs = []
    for grid in GRIDS:
        side, cells = SIDE // grid, []
        for row in range(grid):
            for column in range(grid):
                cell = grey[row * side :, column * side :][:side, :side].astype(float)
                half = side // 2
                dx = cell[:, half:].mean() - cell[:, :half].mean()
                dy = cell[half:].mean() - cell[:half].mean()
                cells.append((cell.mean(), dx, dy))
        for kind in range(3):
            signs += [np.sign(round(one[kind] - other[kind], 6)) for one, other in combinations(cells, 2)]
    return np.array(signs)


@pytest.mark.parametrize("seed", range(4))
def test_signs_are_those_of_the_definition(seed: int) -> None:
    picture = picture_of(seed)
    expected = slow_signs(picture[:, :, 0])
    assert len(expected) == SIZE
    np.testing.assert_array_equal(np.sign(describe(picture)), expected)


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 999), gain=st.integers(1, 5), offset=st.integers(0, 50))
def test_gain_and_offset_change_nothing(seed: int, gain: int, offset: int) -> None:
    picture = picture_of(seed, 0, 40)
    changed = (picture * gain + offset).astype(np.uint8)
    np.testing.assert_array_equal(describe(changed), describe(picture))


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 999))
def test_the_negative_has_the_opposite_signs(seed: int) -> None:
    picture = picture_of(seed)
    np.testing.assert_array_equal(describe(255 - picture), -describe(picture))


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 999), other=st.integers(0, 999))
def test_cosine_is_hamming_distance(seed: int, other: int) -> None:
    rng = np.random.default_rng(seed)
    # Of random pixels hardly any two of the compared sums are equal.
    first, second = (rng.integers(0, 256, (SIDE, SIDE, 3), dtype=np.uint8) for _ in range(2))
    one, two = describe(first), describe(second)
    bits_one, bits_two = one > 0, two > 0
    ties = np.count_nonzero(one == 0) + np.count_nonzero(two == 0)
    hamming = np.count_nonzero(bits_one != bits_two)
    assert one @ two == pytest.approx(1.0 - 2.0 * hamming / SIZE, abs=2.0 * ties / SIZE + 1e-5)
    assert ties < 20


def test_ties_are_zero_and_the_rest_has_equal_weight() -> None:
    # Bright on the left: the grids of even number see two columns of equal cells each.
    picture = np.zeros((SIDE, SIDE, 3), dtype=np.uint8)
    picture[:, : SIDE // 2] = 200
    vector = describe(picture)
    assert np.linalg.norm(vector) == pytest.approx(1.0, abs=1e-6)
    assert len(np.unique(np.abs(vector))) == 2
    # 2 x 2, intensity: 0-1, 0-2, 0-3, 1-2, 1-3, 2-3.
    np.testing.assert_array_equal(np.sign(vector[:6]), [1, 0, 1, -1, 0, 1])


def test_a_bigger_picture_of_the_same_has_the_same_signs() -> None:
    picture = picture_of(7)
    np.testing.assert_array_equal(describe(np.kron(picture, np.ones((3, 3, 1), dtype=np.uint8))), describe(picture))
