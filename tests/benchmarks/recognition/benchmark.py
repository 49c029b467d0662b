"""Recognition: time of a match over one product X^T Y, against Algorithm 2 and CVXPY, growth, convergence.

All times are compared within one process. Ratios are medians over repetitions of a query, in which product and match
take turns; of these the median and the worst over queries are reported.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

from tqdm import tqdm

from services.experiments.evaluation.objective_experiment import convergence
from services.experiments.evaluation.report.recognition_figures import objective
from services.recordings.dataset import find_recordings
from tests.benchmarks.command_line import Parser, say
from tests.benchmarks.machine import machine
from tests.benchmarks.recognition.algorithm2 import from_one_solve, whole_run
from tests.benchmarks.recognition.campus import campus
from tests.benchmarks.recognition.cvxpy_peer import against_cvxpy
from tests.benchmarks.recognition.datasets import Dataset, Problem, Synthetic
from tests.benchmarks.recognition.growth import growth
from tests.benchmarks.recognition.images import ImageFolder
from tests.benchmarks.recognition.matching import TOLERANCE, measure, problems
from tests.benchmarks.recognition.plan import QUICK, Plan
from tests.benchmarks.recognition.tables import as_text
from tests.benchmarks.recognition.targets import judge
from tests.benchmarks.results import LeftOutError, Record

DATASETS: Final = ("synthetic", "campus", "real")
PARTS: Final = ("matching", "algorithm2", "cvxpy", "convergence")
_BAR: Final = "{l_bar}{bar}| {elapsed}<{remaining}{postfix}"


@dataclass(frozen=True)
class Choice:
    """What of the benchmark to run.

    Parameters
    ----------
    parts, datasets : sequence of str
    recordings : Path, optional
        Drives on the campus; without them they are driven.
    images : tuple of ImageFolder
    out : Path, optional
        Folder for pictures.
    """

    parts: Sequence[str] = PARTS
    datasets: Sequence[str] = DATASETS
    recordings: Path | None = None
    images: tuple[ImageFolder, ...] = ()
    out: Path | None = None


@dataclass
class Report:
    """Results as they come in.

    Attributes
    ----------
    left_out : dict of str to str
        What did not run, and why.
    """

    matching: list[Record] = field(default_factory=list)
    growth: list[Record] = field(default_factory=list)
    algorithm2: list[Record] = field(default_factory=list)
    cvxpy: list[Record] = field(default_factory=list)
    convergence: dict[str, Any] | None = None
    left_out: dict[str, str] = field(default_factory=dict)

    def leave_out(self, what: str, reason: object) -> None:
        """Note what did not run; a second reason is added to the first."""
        known = self.left_out.get(what)
        self.left_out[what] = str(reason) if known is None else f"{known}; {reason}"


def benchmark(plan: Plan, choice: Choice) -> dict[str, Any]:
    """Measure what was chosen; return what the JSON file holds."""
    report = Report()
    for name, known in (("part", PARTS), ("dataset", DATASETS)):
        for left in [one for one in known if one not in getattr(choice, f"{name}s")]:
            report.leave_out(f"{name} {left}", f"not among the chosen {name}s")
    largest = max(*plan.sizes, *(n for n, _ in (*plan.whole_runs, *plan.one_solves, *plan.cvxpy, plan.figure)))
    synthetic = Synthetic(largest, plan.features)
    if "matching" in choice.parts:
        _match_all(plan, choice, synthetic, report)
    _compare_with_peers(plan, choice, synthetic, report)
    if "convergence" in choice.parts:
        _converge(synthetic.problem(*plan.figure, 1), choice.out, report)
    results: dict[str, Any] = {"benchmark": "recognition", "machine": machine(), "tolerance": TOLERANCE}
    results |= vars(report)
    return results | {"targets": judge(results)}


def _match_all(plan: Plan, choice: Choice, synthetic: Dataset, report: Report) -> None:
    """Time matching on all datasets, and fit the growth."""
    sources: list[tuple[str, Callable[[], Dataset]]] = []
    if "synthetic" in choice.datasets:
        sources.append(("synthetic", lambda: synthetic))
    if "campus" in choice.datasets:
        sources.append(("campus", partial(campus, choice.recordings, plan.episodes, plan.recoveries)))
    if "real" in choice.datasets:
        sources.extend((folder.name, folder.read) for folder in choice.images)
        if not choice.images:
            report.leave_out("dataset real", "no folder of images was given (--images DIR)")
    for name, load in sources:
        try:
            _match(load(), plan, report)
        except LeftOutError as reason:
            report.leave_out(f"dataset {name}", reason)
    try:
        report.growth = growth(report.matching, "synthetic", plan.growth_from)
    except LeftOutError as reason:
        report.leave_out("growth", reason)


def _match(dataset: Dataset, plan: Plan, report: Report) -> None:
    """Time one dataset at all sizes; the bar goes by the work, of which a template needs one part for each column."""
    work = sum(n * (length + 4) for n in plan.sizes for length in plan.lengths)
    with tqdm(total=work, desc=f"matching {dataset.name}", bar_format=_BAR, dynamic_ncols=True) as bar:
        for n, problem in problems(dataset, plan.sizes, plan.lengths, plan.queries):
            if isinstance(problem, str):
                report.leave_out(f"sizes of {dataset.name}", problem)
                continue
            bar.set_postfix_str(f"l {problem.length}, n {problem.n:,}")
            facts = measure(problem, plan.repetitions_for(problem.n))
            report.matching.append({"dataset": dataset.name, "n_wanted": n, **facts})
            bar.update(n * (problem.length + 4))


def _compare_with_peers(plan: Plan, choice: Choice, synthetic: Dataset, report: Report) -> None:
    """Compare with Algorithm 2 and with CVXPY, on the synthetic video."""
    jobs: list[tuple[str, tuple[int, int], Callable[[Problem], None]]] = []
    if "algorithm2" in choice.parts:
        jobs += [("algorithm2", size, lambda one: report.algorithm2.append(whole_run(one))) for size in plan.whole_runs]
        jobs += [("algorithm2", size, partial(_time_one_solve, report)) for size in plan.one_solves]
    if "cvxpy" in choice.parts:
        jobs += [
            ("cvxpy", size, lambda one: report.cvxpy.extend(against_cvxpy(one, (TOLERANCE, TOLERANCE / 10.0))))
            for size in plan.cvxpy
        ]
    with tqdm(jobs, desc="comparing", unit="run", dynamic_ncols=True, disable=not jobs) as bar:
        for part, (n, length), compare in bar:
            bar.set_postfix_str(f"{part}, l {length}, n {n:,}")
            try:
                compare(synthetic.problem(n, length, 1))
            except LeftOutError as reason:
                report.leave_out(f"{part}, n = {n}, l = {length}", reason)


def _time_one_solve(report: Report, problem: Problem) -> None:
    same = [one for one in report.algorithm2 if one["l"] == problem.length and "solve_seconds" not in one]
    if not same:
        raise LeftOutError("no whole run of the same length tells how many iterations it takes")
    report.algorithm2.append(from_one_solve(problem, int(str(same[-1]["iterations"]))))


def _converge(problem: Problem, out: Path | None, report: Report) -> None:
    report.convergence = convergence(problem.templates, problem.queries[0], problem.length, (problem.penalty,) * 2)
    if out is None:
        report.leave_out("picture of the convergence", "no folder for pictures was given (--out DIR)")
        return
    objective({"a synthetic video": report.convergence}).savefig(out / "convergence.png", dpi=130)


def main(arguments: list[str]) -> None:
    """Read the flags, measure, print and write."""
    flags = _parser().parse(arguments)
    choice = Choice(
        flags.part or PARTS,
        flags.dataset or DATASETS,
        flags.recordings,
        tuple(ImageFolder.find(folder) for folder in flags.images),
        flags.out,
    )
    if flags.recordings is not None:
        find_recordings([flags.recordings])
    results = benchmark(QUICK if flags.quick else Plan(), choice)
    say(flags, results, as_text(results))
    if choice.out is not None and results["convergence"]:
        sys.stdout.write(f"picture: {choice.out / 'convergence.png'}\n")


def _parser() -> Parser:
    parser = Parser("recognition", __doc__)
    parser.add_argument("--recordings", type=Path, metavar="DIR", help="drives on the campus (smal demonstrate "
                        "--camera 320x240); without them they are driven, which takes minutes")  # fmt: skip
    parser.add_argument("--images", type=Path, metavar="DIR", action="append", default=[], help="real frames, may be "
                        "repeated: folders ref and query in it, or half of its images each")  # fmt: skip
    for name, known in (("part", PARTS), ("dataset", DATASETS)):
        parser.add_argument(f"--{name}", action="append", choices=known, help=f"only this {name}; may be repeated")
    return parser
