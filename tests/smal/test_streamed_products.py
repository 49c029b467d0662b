"""Products that are kept in float32 say how wrong they may be, and no certificate is better than that allows."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from smal import Solution, StreamingMatcher, TemplateIndex, solve
from smal.matching import streaming
from smal.matching.frame_ring import KEPT, FrameRing
from smal.matching.inner_products import DualBounds, DualPoint
from smal.matching.screening import Penalty
from smal.matching.streamed_products import StreamedProducts
from smal.matching.template_index import GRAM_PRECISION
from smal.matching.working_set import minimise
from tests.smal.matching import Problem, check
from tests.smal.worlds import corridor, matching_problem, unit

LENGTH, LAMBDAS = 5, (0.25, 0.25)


def route(noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Templates (m, n) of a route driven twice, and a third drive as frames (f, m)."""
    rng = np.random.default_rng(0)
    views = corridor(40, 150, 1)
    drives = [unit(views + noise * unit(rng.standard_normal(views.shape))).astype(np.float32) for _ in range(3)]
    return np.asfortranarray(np.concatenate(drives[:2]).T), drives[2]


@pytest.mark.parametrize("m", [1, 63, 64, 65, 1000])
@pytest.mark.parametrize("n", [1, 255, 256, 300])
def test_products_of_templates_are_as_exact_as_they_claim(m: int, n: int) -> None:
    rng = np.random.default_rng(m * n)
    # Nothing cancels, so that every rounding counts.
    X = (np.abs(rng.standard_normal((m, n))) * 10.0 ** rng.uniform(-3, 3, n)).astype(np.float32)
    gram, truth = TemplateIndex(X).gram(), X.T.astype(np.float64) @ X.astype(np.float64)
    lengths = np.linalg.norm(X.astype(np.float64), axis=0)
    assert gram.dtype == np.float32
    np.testing.assert_array_equal(gram, gram.T)
    assert (np.abs(gram - truth) <= GRAM_PRECISION * np.outer(lengths, lengths)).all()


def test_the_ring_refines_what_is_asked_for_and_forgets_old_frames() -> None:
    X, frames = route(0.3)
    ring, X64 = FrameRing(TemplateIndex(X), LENGTH), X.astype(np.float64)
    asked = np.array([70, 3, 4, 5])
    for count, frame in enumerate(frames[:13], start=1):
        ring.observe(frame)
        held = min(count, LENGTH)
        places = ring.places(held)
        truth = X64.T @ frames[count - held : count].T.astype(np.float64)
        refined = ring.correlations(asked, places[-2:])
        np.testing.assert_allclose(refined, truth[asked, -2:], rtol=0, atol=2 * KEPT)
        values, radii = ring.estimates(places)
        assert (np.abs(values - truth) <= radii).all()
        assert (radii[asked, -2:] <= 4 * KEPT).all()
        assert (radii[0] > 1e-4).all()  # nobody asked
        np.testing.assert_array_equal(values[asked, -2:], refined)


class _Corrupted(StreamedProducts):
    """Products as wrong as they may be, each in the direction that a seed says."""

    def __init__(self, *arguments: object, seed: int) -> None:
        super().__init__(*arguments)  # type: ignore[arg-type]
        rng = np.random.default_rng(seed)
        lengths = self.lengths()
        wrong = rng.choice([-1.0, 1.0], self._gram.shape)
        wrong = np.triu(wrong) + np.triu(wrong, 1).T
        self._gram = (self._gram + 0.9 * GRAM_PRECISION * np.outer(lengths, lengths) * wrong).astype(np.float32)


def corrupted_bound(seed: int, noise: float, scale: float) -> float:
    """Return by how much the bound from wrong products is below the optimum, as a share of it."""
    X, Y = matching_problem(seed % 1000, blocks=12, length=LENGTH, size=100, noise=noise, mixed=3)
    index = TemplateIndex(X)
    ring = FrameRing(index, LENGTH)
    for frame in Y.T:
        ring.observe(frame)
    products = _Corrupted(ring, ring.places(LENGTH), index.gram(), seed=seed)
    found = minimise(products, Penalty(LENGTH, scale, scale, 1e-6), np.zeros(0, dtype=np.intp))
    best = solve(X, Y, LENGTH, scale, scale, tolerance=1e-7).objective
    return 1.0 - found.lower_bound / best


@settings(max_examples=25, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**31), noise=st.sampled_from([0.0, 0.05, 0.5]), scale=st.sampled_from([0.1, 0.3]))
def test_no_bound_is_above_the_optimum_however_products_are_rounded(seed: int, noise: float, scale: float) -> None:
    below = corrupted_bound(seed, noise, scale)
    assert below >= -1e-9
    if noise >= 0.5:  # without residuals it may be worthless
        assert below <= 1e-3


def test_it_would_be_above_if_rounding_were_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    def as_given(products: StreamedProducts, dual: DualPoint) -> DualBounds:
        correlations = products.restricted(dual.columns)[1]
        value = float(dual.alpha @ products.squares - (correlations * dual.B).sum())
        return DualBounds(value, 1.0, np.zeros(dual.alpha.size))

    monkeypatch.setattr(_Corrupted, "dual_bounds", as_given)
    assert min(corrupted_bound(seed, 0.5, 0.3) for seed in range(10)) < -1e-6


def matched(
    noise: float, scale: float, tolerance: float, monkeypatch: pytest.MonkeyPatch
) -> tuple[Solution, Problem, list[int]]:
    """Match a stream, and tell how many times that was done in float64."""
    calls: list[int] = []

    def exactly(*arguments: object) -> object:
        calls.append(1)
        return original(*arguments)  # type: ignore[arg-type]

    original = streaming.StreamedQuery
    monkeypatch.setattr(streaming, "StreamedQuery", exactly)
    X, frames = route(noise)
    matcher = StreamingMatcher(X, LENGTH, scale, scale, tolerance)
    for frame in frames[10 : 10 + LENGTH]:
        matcher.observe(frame)
    return matcher.match(), Problem(X, frames[10 : 10 + LENGTH].T, LENGTH, scale, scale), calls


def test_float64_is_not_needed_where_templates_leave_something_unexplained(monkeypatch: pytest.MonkeyPatch) -> None:
    found, problem, exactly = matched(0.3, 0.25, 1e-3, monkeypatch)
    check(found, problem, 1e-3)
    assert not exactly


@pytest.mark.parametrize(("noise", "scale", "tolerance"), [(0.0, 0.02, 1e-3), (0.3, 0.25, 1e-6)])
def test_float64_where_rounding_would_take_up_the_gap(
    noise: float, scale: float, tolerance: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames that were taught exactly leave no residual where weights cost little; and a tolerance may be too small."""
    found, problem, exactly = matched(noise, scale, tolerance, monkeypatch)
    check(found, problem, tolerance)
    assert len(exactly) == 1


@pytest.mark.parametrize("scale", [1e-14, 1e14])
def test_templates_whose_products_float32_cannot_hold(scale: float) -> None:
    X, frames = route(0.3)
    scaled = (X * scale).astype(np.float32)
    matcher = StreamingMatcher(scaled, LENGTH, *(one * scale for one in LAMBDAS), 1e-3)
    for frame in frames[10 : 10 + LENGTH]:
        matcher.observe(frame)
    problem = Problem(scaled, frames[10 : 10 + LENGTH].T, LENGTH, *(one * scale for one in LAMBDAS))
    check(matcher.match(), problem, 1e-3)
