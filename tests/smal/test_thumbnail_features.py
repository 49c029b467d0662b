"""Thumbnail: patches without brightness and contrast."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from smal.features import modality_named
from smal.features.thumbnail import COLUMNS, PATCH, ROWS

describe = modality_named("thumbnail").describe


def patches_of(vector: np.ndarray) -> np.ndarray:
    """Return the patches (32, 64 pixels)."""
    cells = vector.reshape(ROWS // PATCH, PATCH, COLUMNS // PATCH, PATCH)
    return cells.swapaxes(1, 2).reshape(-1, PATCH * PATCH)


@settings(max_examples=20)
@given(rows=st.integers(24, 300), columns=st.integers(32, 300), seed=st.integers(0, 99))
def test_patches_have_zero_mean_and_equal_deviation(rows: int, columns: int, seed: int) -> None:
    picture = np.random.default_rng(seed).integers(0, 256, (rows, columns, 3), dtype=np.uint8)
    patches = patches_of(describe(picture))
    np.testing.assert_allclose(patches.mean(axis=1), 0.0, atol=1e-6)
    np.testing.assert_allclose(patches.std(axis=1), 1.0 / np.sqrt(ROWS * COLUMNS), rtol=1e-4)
