"""The depth modality: nearness by hand, scale, what is not in range, and what is refused."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from smal.features import MODALITIES, FeatureSettings, extract

ROWS, COLUMNS = 24, 32
ALL = FeatureSettings.of(("color", "hog", "depth"))
describe = MODALITIES["depth"].describe
_millimetres = st.integers(0, 65535)


def scene(seed: int, rows: int = ROWS, columns: int = COLUMNS) -> np.ndarray:
    """Return distances from 0.2 m to 60 m, of which a quarter is out of range."""
    rng = np.random.default_rng(seed)
    depth = np.exp(rng.uniform(np.log(200), np.log(60_000), (rows, columns)))
    return np.where(rng.random((rows, columns)) < 0.25, 0, depth).astype(np.uint16)


def nearness(millimetres: int) -> float:
    """Calculate anew, in metres and double precision, what stands in the module's documentation."""
    return 5.0 / (5.0 + millimetres / 1000.0) if millimetres else 0.0


@given(seed=st.integers(0, 99))
def test_each_cell_is_the_nearness_of_what_is_there(seed: int) -> None:
    depth = scene(seed)
    expected = np.array([nearness(one) for one in depth.ravel().tolist()])
    np.testing.assert_allclose(describe(depth), expected / np.linalg.norm(expected), rtol=1e-5, atol=1e-7)


@settings(deadline=None)
@given(seed=st.integers(0, 99), times=st.integers(2, 10))
def test_the_size_of_the_image_does_not_count(seed: int, times: int) -> None:
    depth = scene(seed)
    larger = np.repeat(np.repeat(depth, times, axis=0), times, axis=1)
    np.testing.assert_allclose(describe(larger), describe(depth), rtol=1e-4, atol=1e-6)


@given(millimetres=_millimetres, rows=st.integers(1, 60), columns=st.integers(1, 60))
def test_a_wall_straight_ahead_has_no_shape(millimetres: int, rows: int, columns: int) -> None:
    vector = describe(np.full((rows, columns), millimetres, dtype=np.uint16))
    assert vector.shape == (MODALITIES["depth"].size,) == (ROWS * COLUMNS,)
    assert vector.dtype == np.float32
    expected = 1.0 / np.sqrt(ROWS * COLUMNS) if millimetres else 0.0
    np.testing.assert_allclose(vector, expected, rtol=1e-4)


@given(seed=st.integers(0, 99), row=st.integers(0, ROWS - 1), column=st.integers(0, COLUMNS - 1), far=st.floats(1, 2))
def test_what_comes_nearer_counts_more(seed: int, row: int, column: int, far: float) -> None:
    depth = np.maximum(scene(seed), 200)
    farther = depth.copy()
    farther[row, column] = min(65535, int(far * depth[row, column]) + 50)
    before, after = (describe(one).reshape(ROWS, COLUMNS)[row, column] for one in (depth, farther))
    assert after < before


def test_a_cell_of_post_and_sky_is_half_as_near_as_the_post() -> None:
    half = np.tile(np.array([[2_000, 0], [2_000, 0]], dtype=np.uint16), (ROWS, COLUMNS))
    half[:, COLUMNS:] = 2_000
    vector = describe(half).reshape(ROWS, COLUMNS)
    np.testing.assert_allclose(2 * vector[:, : COLUMNS // 2], vector[:, COLUMNS // 2 :], rtol=1e-5)


def test_out_of_range_is_what_the_farthest_surface_tends_to() -> None:
    """A surface that leaves the range must not change the descriptor much, and noise far away must not count."""
    depth = scene(1)
    edge = np.where(depth == 0, 65_000, depth).astype(np.uint16)
    cosine = describe(depth) @ describe(edge)
    assert cosine > 0.99
    near, noisy_near, far, noisy_far = (
        describe(np.where(np.arange(COLUMNS) < 16, 2_000, other).astype(np.uint16) * np.ones((ROWS, 1), np.uint16))
        for other in (2_000, 4_000, 40_000, 42_000)
    )
    assert np.linalg.norm(far - noisy_far) < 0.1 * np.linalg.norm(near - noisy_near)


@given(seed=st.integers(0, 99), light=st.floats(0.05, 1.0))
@settings(max_examples=20, deadline=None)
def test_light_does_not_enter(seed: int, light: float) -> None:
    picture = np.random.default_rng(seed).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    where = ALL.slices[2]
    by_day, by_night = (extract(one, ALL, scene(seed)) for one in (picture, (light * picture).astype(np.uint8)))
    np.testing.assert_array_equal(by_day[where], by_night[where])
    np.testing.assert_array_equal(by_day[where], describe(scene(seed)))


@pytest.mark.parametrize(
    ("depth", "words"),
    [
        (None, "the features color, hog, depth need a depth image"),
        (np.ones((24, 32), dtype=np.float32), "uint16 in millimetres, got float32"),
        (np.ones((24, 32, 1), dtype=np.uint16), r"shape \(height, width\), got \(24, 32, 1\)"),
        (np.ones((0, 32), dtype=np.uint16), "shape"),
    ],
)
def test_other_depth_images_are_refused(depth: np.ndarray | None, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        extract(np.zeros((48, 64, 3), dtype=np.uint8), ALL, depth)


def test_depth_is_not_looked_at_where_it_is_not_wanted() -> None:
    picture = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    wrong = np.zeros(3, dtype=np.float32)
    np.testing.assert_array_equal(
        extract(picture, FeatureSettings(), wrong),  # type: ignore[arg-type]
        extract(picture, FeatureSettings()),
    )
