"""The ways to match that are timed."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Final

from smal.matching.streaming import StreamingMatcher
from smal.state_matching import Solution, solve

if TYPE_CHECKING:
    from smal.matching.template_index import TemplateIndex
    from tests.benchmarks.recognition.datasets import Frames, Problem

#: What each mode times. Streaming matches the same query; the window before it was matched already, untimed.
MODES: Final = {
    "plain": "solve(templates, query)",
    "index": "solve(TemplateIndex(templates), query)",
    "streaming": "observe(last frame) and match(), the window before being one frame earlier",
    "streaming-by-l": "observe(last frame) and match(), the window before being l frames earlier",
}
TOLERANCE: Final = 1e-4


def prepare(
    mode: str,
    problem: Problem,
    stream: Frames,
    index: TemplateIndex | None = None,
    matcher: StreamingMatcher | None = None,
) -> Callable[[], Callable[[], Solution]]:
    """Give what prepares one timed match; each preparation forgets what the last one learned about the query."""
    length, penalty = problem.length, problem.penalty
    query = stream[:, length:]
    if mode == "plain":
        return lambda: partial(solve, problem.templates, query, length, penalty, penalty, TOLERANCE)
    if mode == "index" and index is not None:
        return lambda: partial(solve, index, query, length, penalty, penalty, TOLERANCE)
    if matcher is None:
        raise ValueError(f"the mode {mode} needs an index or a matcher")
    earlier = length if mode == "streaming-by-l" else 1
    return partial(_prepare_streaming, matcher, length, stream, earlier)


def _prepare_streaming(matcher: StreamingMatcher, length: int, stream: Frames, earlier: int) -> Callable[[], Solution]:
    """Observe and match the window so many frames earlier, then observe all frames but the last."""
    matcher.reset()
    for frame in stream.T[length - earlier : 2 * length - earlier]:
        matcher.observe(frame)
    matcher.match()
    for frame in stream.T[2 * length - earlier : -1]:
        matcher.observe(frame)
    last = stream.T[-1]

    def observe_and_match() -> Solution:
        matcher.observe(last)
        return matcher.match()

    return observe_and_match
