"""Time of a match over the time of one product X^T Y of the same sizes, for every way to match."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from smal.matching.streaming import StreamingMatcher
from smal.matching.template_index import TemplateIndex
from smal.state_matching import Solution
from tests.benchmarks.machine import array_bytes, peak_memory_increase
from tests.benchmarks.recognition.modes import TOLERANCE, prepare
from tests.benchmarks.timing import Paired, paired, seconds_of

if TYPE_CHECKING:
    from tests.benchmarks.recognition.datasets import Dataset, Problem
    from tests.benchmarks.results import Record


def problems(
    dataset: Dataset, sizes: Sequence[int], lengths: Sequence[int], queries: int
) -> Iterator[tuple[int, Problem | str]]:
    """Give the wanted n and the problem for every size and length, or the reason why it is left out.

    Once the frames do not suffice for one n, larger ones would be the same problem again.
    """
    for length in lengths:
        reached = 0
        for n in sizes:
            try:
                problem = dataset.problem(n, length, queries)
            except ValueError as error:
                yield n, f"l = {length}: {error}"
                break
            again = problem.n == reached
            yield n, f"l = {length}, n = {n:,}: its frames make {reached:,} templates at most" if again else problem
            reached = problem.n


def measure(problem: Problem, modes: Sequence[str], repetitions: int) -> Record:
    """Time all modes for all queries of a problem."""
    index, facts = _build_index(problem) if set(modes) - {"plain"} else (None, {})
    one_solve = prepare("plain", problem, problem.streams[0])()
    one_solve()  # compiles
    facts["solve_peak_memory_bytes"] = peak_memory_increase(one_solve)
    # One frame is both one frame and l frames earlier.
    timed = [mode for mode in modes if not (problem.length == 1 and mode == "streaming-by-l")]
    # One for all repetitions: a reset forgets everything but the templates and their products.
    matcher = None
    if index is not None and set(timed) - {"plain", "index"}:
        matcher = StreamingMatcher(index, problem.length, problem.penalty, problem.penalty, TOLERANCE)
    runs = {mode: _time(mode, problem, index, matcher, repetitions) for mode in timed}
    units = np.concatenate([one.unit_s for each in runs.values() for one in each])
    return {
        "n": problem.n,
        "m": int(problem.templates.shape[0]),
        "l": problem.length,
        "stride": problem.stride,
        "lambda1": problem.penalty,
        "lambda2": problem.penalty,
        "queries": len(problem.streams),
        "repetitions": repetitions,
        "product_seconds": float(np.median(units)),
        "template_bytes": int(problem.templates.itemsize * problem.templates.shape[0]),
        **facts,
        "modes": {mode: _summary(each, runs[timed[0]]) for mode, each in runs.items()},
    }


def _build_index(problem: Problem) -> tuple[TemplateIndex, Record]:
    TemplateIndex(problem.templates[:, : problem.length])  # compiles
    seconds, index = seconds_of(lambda: TemplateIndex(problem.templates))
    size = array_bytes(index, but=problem.templates)
    return index, {"index_build_seconds": seconds, "index_bytes_per_template": size / problem.n}


def _time(
    mode: str, problem: Problem, index: TemplateIndex | None, matcher: StreamingMatcher | None, repetitions: int
) -> list[Paired[Solution]]:
    def time_one(k: int) -> Paired[Solution]:
        query = problem.queries[k]
        subject = prepare(mode, problem, problem.streams[k], index, matcher)
        return paired(lambda: problem.templates.T @ query, subject, repetitions)

    return [time_one(k) for k in range(len(problem.streams))]


def _summary(runs: list[Paired[Solution]], others: list[Paired[Solution]]) -> Record:
    """Condense the runs of one mode; ``others`` solved the same queries another way."""
    answers = [one.answer for one in runs]
    matched = [one for one in answers if one.active.size]
    apart = [
        abs(one.objective - other.answer.objective) / other.answer.objective
        for one, other in zip(answers, others, strict=True)
    ]
    return {
        "seconds": float(np.median([one.seconds for one in runs])),
        "seconds_worst": max(one.seconds for one in runs),
        "ratio": float(np.median([one.ratio for one in runs])),
        "ratio_worst": max(one.ratio for one in runs),
        "queries_without_match": len(answers) - len(matched),
        "active_sequences": float(np.median([len(one.active_blocks) for one in answers])),
        "active_rows": float(np.median([one.active.size for one in answers])),
        "iterations": float(np.median([one.iterations for one in answers])),
        "duality_gap": max(one.duality_gap for one in answers),
        "converged": all(one.converged for one in answers),
        "objective_difference": max(apart),
    }
