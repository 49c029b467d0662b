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


def grey_picture(seed: int, brightest: int) -> np.ndarray:
    grey = np.random.default_rng(seed).integers(0, brightest + 1, (ROWS, COLUMNS), dtype=np.uint8)
    return np.repeat(grey[:, :, None], 3, axis=2)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 999), shadow=st.integers(0, 31))
def test_a_shadow_over_one_patch_changes_nothing(seed: int, shadow: int) -> None:
    picture = grey_picture(seed, 100) * np.uint8(2)
    row, column = divmod(shadow, COLUMNS // PATCH)
    where = (slice(row * PATCH, (row + 1) * PATCH), slice(column * PATCH, (column + 1) * PATCH))
    dark = picture.copy()
    dark[where] //= 2
    np.testing.assert_allclose(describe(dark), describe(picture), atol=1e-6)


@settings(max_examples=20, deadline=None)
@given(rows=st.integers(24, 300), columns=st.integers(32, 300), seed=st.integers(0, 99))
def test_every_patch_has_no_mean_and_the_same_deviation(rows: int, columns: int, seed: int) -> None:
    picture = np.random.default_rng(seed).integers(0, 256, (rows, columns, 3), dtype=np.uint8)
    patches = patches_of(describe(picture))
    np.testing.assert_allclose(patches.mean(axis=1), 0.0, atol=1e-6)
    np.testing.assert_allclose(patches.std(axis=1), 1.0 / np.sqrt(ROWS * COLUMNS), rtol=1e-4)
