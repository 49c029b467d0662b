"""A stream of frames is matched as its last l frames are."""

import numpy as np
import pytest

from smal import StreamingMatcher, solve
from tests.smal.paper.matching import Problem, check, check_bounds
from tests.smal.worlds import corridor, unit

LENGTH = 5
LAMBDAS = (0.25, 0.25)


def route(frames: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Templates (m, n) of a route driven three times, and a fourth drive as frames (f, m)."""
    rng = np.random.default_rng(0)
    views = corridor(frames, 150, 1)
    drives = [unit(views + 0.3 * unit(rng.standard_normal(views.shape))).astype(np.float32) for _ in range(4)]
    return np.asfortranarray(np.concatenate(drives[:3]).T), drives[3]


@pytest.mark.parametrize("tolerance", [1e-3, 1e-6])
def test_every_window_of_a_drive(tolerance: float) -> None:
    X, frames = route()
    matcher = StreamingMatcher(X, LENGTH, *LAMBDAS, tolerance)
    for t, frame in enumerate(frames):
        matcher.observe(frame)
        assert matcher.ready == (t >= LENGTH - 1)
        if not matcher.ready or t % 3:
            continue
        window = frames[t - LENGTH + 1 : t + 1]
        np.testing.assert_array_equal(matcher.window(), window)
        problem = Problem(X, np.asfortranarray(window.T), LENGTH, *LAMBDAS)
        solutions = {"stream": matcher.match(), "plain": solve(X, problem.Y, *problem.parameters, tolerance)}
        check(solutions["stream"], problem, tolerance)
        check_bounds(solutions, min(solution.objective for solution in solutions.values()))


def test_reset_forgets_everything() -> None:
    X, frames = route()
    matcher, fresh = (StreamingMatcher(X, LENGTH, *LAMBDAS) for _ in range(2))
    for frame in frames[:13]:
        matcher.observe(frame)
    matcher.match()
    matcher.reset()
    assert not matcher.ready
    for frame in frames[25 : 25 + LENGTH]:
        with pytest.raises(ValueError, match="needs 5 frames"):
            matcher.match()
        matcher.observe(frame)
        fresh.observe(frame)
    again, first = matcher.match(), fresh.match()
    np.testing.assert_array_equal(again.weights, first.weights)
    assert again.iterations == first.iterations


def test_not_ready_is_refused() -> None:
    X, frames = route()
    matcher = StreamingMatcher(X, LENGTH, *LAMBDAS)
    for count in range(LENGTH):
        assert not matcher.ready
        with pytest.raises(ValueError, match=f"needs 5 frames, there are {count}"):
            matcher.match()
        matcher.observe(frames[count])
    assert matcher.ready


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_refused_frame_changes_nothing(bad: float) -> None:
    X, frames = route()
    matcher, undisturbed = (StreamingMatcher(X, LENGTH, *LAMBDAS) for _ in range(2))
    for frame in frames[:8]:
        broken = frame.copy()
        broken[-1] = bad
        with pytest.raises(ValueError, match="NaN or infinity"):
            matcher.observe(broken)
        with pytest.raises(ValueError, match="must have the shape"):
            matcher.observe(frame[:-1])
        with pytest.raises(ValueError, match="must have the shape"):
            matcher.observe(frame[:, None])
        matcher.observe(frame)
        undisturbed.observe(frame)
    np.testing.assert_array_equal(matcher.window(), frames[3:8])
    np.testing.assert_array_equal(matcher.match().weights, undisturbed.match().weights)


@pytest.mark.parametrize("zeros", [(0,), (2, 3), (0, 1, 2, 4), (0, 1, 2, 3, 4)])
def test_zero_frames_inside_the_window(zeros: tuple[int, ...]) -> None:
    X, frames = route()
    window = frames[11 : 11 + LENGTH].copy()
    window[list(zeros)] = 0.0
    matcher = StreamingMatcher(X, LENGTH, *LAMBDAS, 1e-5)
    for frame in (*frames[:8], *window):
        matcher.observe(frame)
    solution, problem = matcher.match(), Problem(X, window.T, LENGTH, *LAMBDAS)
    assert not solution.weights[:, list(zeros)].any()
    if len(zeros) == LENGTH:
        assert (solution.objective, solution.duality_gap) == (0.0, 0.0)
    else:
        check(solution, problem, 1e-5)
        plain = solve(X, window.T, *problem.parameters, 1e-5)
        check_bounds({"stream": solution, "plain": plain}, min(solution.objective, plain.objective))
        assert solution.weights.any()
    matcher.observe(frames[30])  # goes on after a window of zeros
    assert matcher.match().converged


def test_bad_parameters_are_refused() -> None:
    X, _ = route()
    for arguments, words in (
        ((X, 0, 0.1, 0.1), "sequence_length"),
        ((X, 5, -0.1, 0.1), "lambda1"),
        ((X, 5, 0.1, 0.1, 0.0), "tolerance"),
        ((X[:, :0], 5, 0.1, 0.1), "at least one template"),
        ((X[0], 5, 0.1, 0.1), "matrix"),
    ):
        with pytest.raises(ValueError, match=words):
            StreamingMatcher(*arguments)
    for column in (0, 60, X.shape[1] - 1):
        broken = X.copy()
        broken[3, column] = np.nan
        with pytest.raises(ValueError, match="NaN or infinity"):
            StreamingMatcher(broken, 5, 0.1, 0.1)
