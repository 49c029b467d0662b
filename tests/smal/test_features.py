"""Features: sizes, unit length and centering."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from smal.features import MODALITIES, Centering, FeatureSettings, extract, select

BOTH = FeatureSettings()
ALL = FeatureSettings.of(("color", "hog", "depth"))
OF_IMAGES = FeatureSettings.of(
    name for name, one in MODALITIES.items() if one.size and one.needs == "color"
)


def image(rows: int, columns: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (rows, columns, 3), dtype=np.uint8)


def depth_image(rows: int, columns: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 65536, (rows, columns), dtype=np.uint16)


@settings(max_examples=30)
@given(rows=st.integers(24, 500), columns=st.integers(32, 500), seed=st.integers(0, 99))
def test_any_size_gives_unit_modalities(rows: int, columns: int, seed: int) -> None:
    vector = extract(image(rows, columns, seed), OF_IMAGES)
    for where in OF_IMAGES.slices:
        assert np.linalg.norm(vector[where]) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("grey", [0, 128])
def test_constant_image_has_no_nan(grey: int) -> None:
    vector = extract(np.full((48, 64, 3), grey, dtype=np.uint8), OF_IMAGES)
    for name, where in zip(OF_IMAGES.modalities, OF_IMAGES.slices, strict=True):
        length = float(np.linalg.norm(vector[where]))
        assert length == pytest.approx(round(length), abs=1e-6), f"{name}: of unit length or zero"
        assert grey or length == 0.0, f"{name}: nothing is seen in black"
    colour = vector[OF_IMAGES.slices[OF_IMAGES.modalities.index("color")]]
    assert np.linalg.norm(colour) == pytest.approx(float(grey > 0), abs=1e-6)


def test_fingerprint_names_the_raw_features() -> None:
    # A change of it invalidates models; features are then computed anew from recorded images.
    assert BOTH.fingerprint == "7f3f78894468"
    assert BOTH.fingerprint != FeatureSettings(("hog", "color")).fingerprint


@given(
    wanted=st.permutations(["color", "hog", "depth"]),
    count=st.integers(1, 3),
    seed=st.integers(0, 9),
)
@settings(max_examples=20)
def test_features_taken_out_are_those_made_without_the_others(
    wanted: list[str], count: int, seed: int
) -> None:
    fewer = FeatureSettings.of(wanted[:count])
    frames = [
        (image(48, 64, seed), depth_image(24, 32, seed)),
        (image(30, 40, seed + 1), depth_image(48, 64, seed)),
    ]
    raw = np.stack([extract(picture, ALL, depth) for picture, depth in frames])
    expected = np.stack([extract(picture, fewer, depth) for picture, depth in frames])
    np.testing.assert_array_equal(select(raw, ALL, fewer), expected)


def test_centering_normalizes_each_modality_alike() -> None:
    raw = np.stack([extract(image(48, 64, seed), BOTH) for seed in range(6)])
    centred = Centering.fit(raw, BOTH).apply(raw)
    assert centred.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(centred, axis=1), 1.0, rtol=1e-5)
    np.testing.assert_allclose(
        np.linalg.norm(centred[:, BOTH.slices[1]], axis=1), 1 / np.sqrt(2), rtol=1e-5
    )
    np.testing.assert_array_equal(
        Centering.fit(list(raw[:, None]), BOTH).mean, Centering.fit(raw, BOTH).mean
    )
