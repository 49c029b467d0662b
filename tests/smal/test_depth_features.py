"""The depth modality: nearness by hand, scale and what is not in range."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from smal.features import MODALITIES, FeatureSettings, extract

ROWS = 24
COLUMNS = 32
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
def test_cell_is_the_nearness_of_its_pixels(seed: int) -> None:
    depth = scene(seed)
    expected = np.array([nearness(one) for one in depth.ravel().tolist()])
    np.testing.assert_allclose(
        describe(depth), expected / np.linalg.norm(expected), rtol=1e-5, atol=1e-7
    )


@given(millimetres=_millimetres, rows=st.integers(1, 60), columns=st.integers(1, 60))
def test_depth_is_uniform_when_a_wall_is_straight_ahead(
    millimetres: int, rows: int, columns: int
) -> None:
    vector = describe(np.full((rows, columns), millimetres, dtype=np.uint16))
    assert vector.shape == (MODALITIES["depth"].size,) == (ROWS * COLUMNS,)
    assert vector.dtype == np.float32
    expected = 1.0 / np.sqrt(ROWS * COLUMNS) if millimetres else 0.0
    np.testing.assert_allclose(vector, expected, rtol=1e-4)


def test_cell_is_half_as_near_when_half_of_it_is_sky() -> None:
    half = np.tile(np.array([[2_000, 0], [2_000, 0]], dtype=np.uint16), (ROWS, COLUMNS))
    half[:, COLUMNS:] = 2_000
    vector = describe(half).reshape(ROWS, COLUMNS)
    np.testing.assert_allclose(2 * vector[:, : COLUMNS // 2], vector[:, COLUMNS // 2 :], rtol=1e-5)


def test_depth_is_not_looked_at_where_it_is_not_wanted() -> None:
    picture = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    wrong = np.zeros(3, dtype=np.float32)
    np.testing.assert_array_equal(
        extract(picture, FeatureSettings(), wrong),
        extract(picture, FeatureSettings()),
    )
