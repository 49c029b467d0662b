"""Time of a match over the time of one product X^T Y of the same sizes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from smal.state_matching import solve
from tests.benchmarks.machine import peak_memory_increase
from tests.benchmarks.timing import paired

if TYPE_CHECKING:
    from tests.benchmarks.recognition.datasets import Dataset, Problem
    from tests.benchmarks.results import Record

TOLERANCE: Final = 1e-4


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


def measure(problem: Problem, repetitions: int) -> Record:
    """Time all queries of a problem; the product and the match take turns."""
    matches = [
        partial(solve, problem.templates, query, problem.length, problem.penalty, problem.penalty, TOLERANCE)
        for query in problem.queries
    ]
    matches[0]()  # compiles
    peak = peak_memory_increase(matches[0])
    runs = [
        paired(partial(np.matmul, problem.templates.T, query), lambda match=match: match, repetitions)
        for query, match in zip(problem.queries, matches, strict=True)
    ]
    answers = [one.answer for one in runs]
    return {
        "n": problem.n,
        "m": int(problem.templates.shape[0]),
        "l": problem.length,
        "stride": problem.stride,
        "lambda1": problem.penalty,
        "lambda2": problem.penalty,
        "queries": len(runs),
        "repetitions": repetitions,
        "product_seconds": float(np.median(np.concatenate([one.unit_s for one in runs]))),
        "template_bytes": int(problem.templates.itemsize * problem.templates.shape[0]),
        "solve_peak_memory_bytes": peak,
        "seconds": float(np.median([one.seconds for one in runs])),
        "seconds_worst": max(one.seconds for one in runs),
        "ratio": float(np.median([one.ratio for one in runs])),
        "ratio_worst": max(one.ratio for one in runs),
        "queries_without_match": sum(not one.active.size for one in answers),
        "active_sequences": float(np.median([len(one.active_blocks) for one in answers])),
        "active_rows": float(np.median([one.active.size for one in answers])),
        "iterations": float(np.median([one.iterations for one in answers])),
        "duality_gap": max(one.duality_gap for one in answers),
        "converged": all(one.converged for one in answers),
    }
