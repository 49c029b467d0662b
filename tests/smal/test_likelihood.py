"""The likelihood of a place: calibrated, monotone, and independent of dimming."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from smal.likelihood import ANY_DAY, GRID, SHARES, Likelihood, standing_out
from smal.teaching.calibration import gamma_of


def fixed(rng: np.random.Generator, tail: float, count: int = 40_000) -> np.ndarray:
    """Draw z of fixed views of other places."""
    usual = rng.standard_normal(count)
    return np.where(rng.random(count) < 0.95, usual, 1.6 + rng.exponential(tail, count))


def best(rng: np.random.Generator, tail: float, of: int) -> np.ndarray:
    """Draw z of the best of several views of other places."""
    return np.max([fixed(rng, tail) for _ in range(of)], axis=0)


@settings(deadline=None, max_examples=20)
@given(
    stands_out=st.floats(2.0, 20.0),
    tail=st.floats(0.3, 3.0),
    of=st.integers(1, 8),
    seed=st.integers(0, 2**16),
)
def test_probability_is_calibrated_when_particles_pick_views(
    stands_out: float, tail: float, of: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    followed = best(rng, tail, of)
    shown = rng.random(40_000) * stands_out + fixed(rng, tail)
    here = np.maximum(shown, best(rng, tail, of))
    found = Likelihood.fit(np.full(100, stands_out), fixed(rng, tail), followed, 1e6, 1.0)
    z = np.concatenate([here, followed])
    said = 1.0 - 1.0 / (1.0 + found.mixed(ANY_DAY, z, 1.0))
    true = np.repeat([1.0, 0.0], len(here))
    bins = np.clip((said * 10).astype(int), 0, 9)
    off = sum(
        (bins == k).mean() * abs(said[bins == k].mean() - true[bins == k].mean())
        for k in set(bins.tolist())
    )
    assert off < 0.05


def test_faint_match_is_little_evidence_when_views_are_picked() -> None:
    rng = np.random.default_rng(0)
    found = Likelihood.fit(np.full(100, 8.0), fixed(rng, 1.0), best(rng, 1.0, 8), 1e6, 1.0)
    lowest = [float(found.of(np.array([z]), 1)[0]) for z in (2.0, 40.0)]
    assert lowest[0] < 0.5
    assert lowest[1] < 2.0
    assert found.of(np.array([8.0])) > 3.0


@settings(deadline=None, max_examples=50)
@given(here=st.lists(st.floats(-2.0, 30.0), min_size=1, max_size=50), seed=st.integers(0, 2**16))
def test_a_view_that_stands_out_more_never_speaks_less(here: list[float], seed: int) -> None:
    elsewhere = np.random.default_rng(seed).standard_normal(500)
    found = Likelihood.fit(np.array(here), elsewhere, elsewhere, 1e6, 1.0)
    assert (np.diff(found.log_ratio) >= 0.0).all()
    assert np.isfinite(found.log_ratio).all()


def test_the_size_of_the_map_does_not_enter() -> None:
    elsewhere = np.random.default_rng(0).standard_normal(1000)
    more = np.tile(elsewhere, 64)
    one = Likelihood.fit(np.full(20, 8.0), elsewhere, elsewhere, 1e6, 1.0)
    other = Likelihood.fit(np.full(2000, 8.0), more, more, 1e6, 1.0)
    np.testing.assert_allclose(one.log_ratio, other.log_ratio, atol=1e-9)


def test_places_that_look_alike_make_views_say_less() -> None:
    rng = np.random.default_rng(0)
    plain = rng.standard_normal(5000)
    alike = np.where(rng.random(5000) < 0.05, rng.normal(8.0, 1.0, 5000), plain)
    unlike_street, street = (
        Likelihood.fit(np.full(20, 9.0), each, each, 1e6, 1.0) for each in (plain, alike)
    )
    assert street.of(np.array([8.0])) < unlike_street.of(np.array([8.0])) - 3.0


def test_of_few_views_elsewhere_little_is_concluded() -> None:
    elsewhere = np.random.default_rng(0).standard_normal(1000)
    few, many = (
        Likelihood.fit(np.full(20, 9.0), elsewhere, elsewhere, independent, 1.0)
        for independent in (20.0, 1e4)
    )
    assert few.of(np.array([8.0])) < many.of(np.array([8.0])) - 3.0


@settings(deadline=None)
@given(scale=st.floats(0.01, 10.0), shift=st.floats(-1.0, 1.0), seed=st.integers(0, 2**16))
def test_dimming_all_views_changes_nothing(scale: float, shift: float, seed: int) -> None:
    cosines, sample = np.random.default_rng(seed).uniform(-1.0, 1.0, (2, 40))
    usual = standing_out(cosines, sample)
    np.testing.assert_allclose(
        standing_out(scale * cosines + shift, scale * sample + shift), usual, rtol=1e-6, atol=1e-6
    )


def test_a_blank_view_stands_out_nowhere() -> None:
    assert not standing_out(np.zeros(5), np.zeros(9)).any()


@pytest.mark.parametrize(("cosine", "correlation"), [(0.5, 0.25), (0.9, 0.6), (0.3, 0.3)])
def test_views_correlate_as_was_measured(cosine: float, correlation: float) -> None:
    found = Likelihood(np.zeros((SHARES.size, GRID.size)), gamma_of(cosine, correlation))
    assert found.correlation(cosine) == pytest.approx(correlation)
    assert found.correlation(1.0) == 1.0
    assert found.correlation(-0.2) == 0.0
