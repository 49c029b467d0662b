"""Recognition: time of a match over one product X^T Y, against Algorithm 2 and CVXPY, and convergence.

All times are compared within one process. Ratios are medians over repetitions of a query, in which product and match
take turns; of these the median and the worst over queries are reported.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from tqdm import tqdm

from services.experiments.evaluation.objective_experiment import convergence
from services.experiments.evaluation.report.recognition_figures import objective
from services.recordings.dataset import find_recordings
from smal.paper.state_matching import solve
from tests.benchmarks.command_line import Parser, say
from tests.benchmarks.machine import machine
from tests.benchmarks.recognition.algorithm2 import from_one_solve, whole_run
from tests.benchmarks.recognition.campus import campus
from tests.benchmarks.recognition.cvxpy_peer import against_cvxpy
from tests.benchmarks.recognition.datasets import Dataset, Problem, Synthetic
from tests.benchmarks.recognition.timing import paired
from tests.benchmarks.results import LeftOutError, Record, table

TOLERANCE: Final = 1e-4


@dataclass(frozen=True)
class Plan:
    """Sizes of everything that is measured; the defaults are the full run.

    Parameters
    ----------
    n : int
        Template frames of the ratios to one product.
    lengths : tuple of int
        And their l.
    features : int
        m of the synthetic video.
    queries, repetitions : int
        For each problem, and for each query.
    whole_runs : tuple of (n, l)
        Of Algorithm 2.
    one_solves : tuple of (n, l)
        Of which a single solve of Algorithm 2 is timed.
    cvxpy : tuple of (n, l)
    figure : (n, l)
        Of the convergence figure.
    episodes, recoveries : int
        Drives to render, where no recordings are given.
    """

    n: int = 10_000
    lengths: tuple[int, ...] = (1, 5, 10, 20)
    features: int = 4096
    queries: int = 5
    repetitions: int = 3
    whole_runs: tuple[tuple[int, int], ...] = ((500, 5), (500, 10), (1_000, 5), (1_000, 10))
    one_solves: tuple[tuple[int, int], ...] = ((5_000, 5), (5_000, 10))
    cvxpy: tuple[tuple[int, int], ...] = ((500, 5), (500, 10))
    figure: tuple[int, int] = (500, 10)
    episodes: int = 12
    recoveries: int = 60


QUICK: Final = Plan(
    n=2_000,
    queries=3,
    whole_runs=((500, 5),),
    one_solves=((2_000, 5),),
    cvxpy=((500, 5),),
    episodes=2,
    recoveries=2,
)


@dataclass
class Report:
    """Results as they come in; ``left_out`` says what did not run, and why."""

    matching: list[Record] = field(default_factory=list)
    algorithm2: list[Record] = field(default_factory=list)
    cvxpy: list[Record] = field(default_factory=list)
    left_out: dict[str, str] = field(default_factory=dict)


def benchmark(plan: Plan, recordings: Path | None, out: Path | None) -> dict[str, Any]:
    """Measure everything; return what the JSON file holds.

    Parameters
    ----------
    plan
        How much.
    recordings
        Drives on the campus; without them they are driven.
    out
        Folder for the picture.
    """
    report = Report()
    synthetic = Synthetic(
        max(plan.n, *(n for n, _ in (*plan.whole_runs, *plan.one_solves, *plan.cvxpy))), plan.features
    )
    _match(synthetic, plan, report)
    try:
        _match(campus(recordings, plan.episodes, plan.recoveries), plan, report)
    except (LeftOutError, ValueError) as reason:
        report.left_out["campus"] = str(reason)
    _compare_with_peers(plan, synthetic, report)
    figure = synthetic.problem(*plan.figure, 1)
    curves = convergence(figure.templates, figure.queries[0], figure.length, (figure.penalty,) * 2)
    if out is not None:
        objective({"a synthetic video": curves}).savefig(out / "convergence.png", dpi=130)
    return {
        "benchmark": "recognition",
        "machine": machine(),
        "tolerance": TOLERANCE,
        **vars(report),
        "convergence": curves,
    }


def _match(dataset: Dataset, plan: Plan, report: Report) -> None:
    """Time one dataset at all lengths."""
    for length in tqdm(plan.lengths, desc=f"matching {dataset.name}", dynamic_ncols=True):
        problem = dataset.problem(plan.n, length, plan.queries)
        report.matching.append({"dataset": dataset.name, **_measure(problem, plan.repetitions)})


def _measure(problem: Problem, repetitions: int) -> Record:
    """Time all queries of a problem; the product and the match take turns."""
    matches = [
        partial(solve, problem.templates, query, problem.length, problem.penalty, problem.penalty, TOLERANCE)
        for query in problem.queries
    ]
    answers = [match() for match in matches]
    times = [
        paired(partial(np.matmul, problem.templates.T, query), match, repetitions)
        for query, match in zip(problem.queries, matches, strict=True)
    ]
    ratios = [float(np.median(each[:, 1] / each[:, 0])) for each in times]
    product_s, match_s = np.median(np.concatenate(times), axis=0)
    return {
        "n": problem.n,
        "m": int(problem.templates.shape[0]),
        "l": problem.length,
        "sequences": float(np.median([len(one.active_blocks) for one in answers])),
        "product_ms": 1e3 * float(product_s),
        "match_ms": 1e3 * float(match_s),
        "ratio": float(np.median(ratios)),
        "ratio_worst": max(ratios),
        "duality_gap": max(one.duality_gap for one in answers),
        "converged": all(one.converged for one in answers),
    }


def _compare_with_peers(plan: Plan, synthetic: Dataset, report: Report) -> None:
    """Compare with Algorithm 2 and with CVXPY, on the synthetic video."""
    jobs: list[tuple[str, tuple[int, int], Callable[[Problem], None]]] = [
        *(("algorithm2", size, lambda one: report.algorithm2.append(whole_run(one))) for size in plan.whole_runs),
        *(("algorithm2", size, partial(_time_one_solve, report)) for size in plan.one_solves),
        *(
            ("cvxpy", size, lambda one: report.cvxpy.extend(against_cvxpy(one, (TOLERANCE, TOLERANCE / 10.0))))
            for size in plan.cvxpy
        ),
    ]
    with tqdm(jobs, desc="comparing", unit="run", dynamic_ncols=True) as bar:
        for part, (n, length), compare in bar:
            bar.set_postfix_str(f"{part}, l {length}, n {n:,}")
            try:
                compare(synthetic.problem(n, length, 1))
            except LeftOutError as reason:
                report.left_out[f"{part}, n = {n}, l = {length}"] = str(reason)


def _time_one_solve(report: Report, problem: Problem) -> None:
    same = [one for one in report.algorithm2 if one["l"] == problem.length and "solve_seconds" not in one]
    report.algorithm2.append(from_one_solve(problem, int(str(same[-1]["iterations"]))))


def as_text(results: dict[str, Any]) -> str:
    """Show the results as tables."""
    whole, single = (
        [one for one in results["algorithm2"] if ("solve_seconds" in one) == timed] for timed in (False, True)
    )
    return "".join([
        table("Time over one float32 product X^T Y (median and worst over queries)", results["matching"]),
        table("Algorithm 2 as published, whole runs to our objective", whole),
        table("Algorithm 2 as published, by the time of one solve and the iterations of the largest whole run", single),
        table("CVXPY with Clarabel", results["cvxpy"]),
        table("Convergence, ours", results["convergence"]["ours"]),
        table("Left out", [{"what": what, "reason": reason} for what, reason in results["left_out"].items()]),
    ])  # fmt: skip


def main(arguments: list[str]) -> None:
    """Read the flags, measure, print and write."""
    parser = Parser("recognition", __doc__)
    parser.add_argument("--recordings", type=Path, metavar="DIR", help="drives on the campus (smal demonstrate "
                        "--camera 320x240); without them they are driven, which takes minutes")  # fmt: skip
    flags = parser.parse(arguments)
    if flags.recordings is not None:
        find_recordings([flags.recordings])
    results = benchmark(QUICK if flags.quick else Plan(), flags.recordings, flags.out)
    say(flags, results, as_text(results))
    if flags.out is not None:
        sys.stdout.write(f"picture: {flags.out / 'convergence.png'}\n")
