"""``smal evaluate``: the paper's experiments, or a comparison of drivers, as a page of results."""

from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from services.cli import options, outputs
from services.experiments.evaluation.drivers import COMPARED, DRIVERS
from services.experiments.evaluation.plan import (
    CELLS,
    COMPARED_RUNS,
    PLANS,
    TAUGHT,
    EvaluationPlan,
    Trial,
    comparison,
    in_world,
    with_each,
)
from services.experiments.evaluation.results import Results
from services.experiments.evaluation.units import Unit, units
from services.experiments.progress import Bars
from services.experiments.words import remark
from services.kit.errors import JobError, UsageError


@dataclass(frozen=True)
class PlanSize:
    """Extent of the evaluation."""

    quick: Annotated[
        bool, Option(help="Fewer drives, lengths and runs: 5 to 10 minutes on two idle cores.")
    ] = False
    world: Annotated[
        str | None, Option(help="Custom world: SMAL and teach and repeat, one drive.")
    ] = None
    runs: Annotated[
        int | None,
        Option(min=1, max=1000, help=f"Number of searches, shared by at most {TAUGHT} drives."),
    ] = None
    base: options.Base = None
    drivers: Annotated[
        str | None,
        Option(
            metavar="NAMES",
            help="Comparison of drivers instead of the experiments, comma-separated: "
            f"{', '.join(DRIVERS)}. [default of a comparison: {','.join(COMPARED)}]",
        ),
    ] = None
    driver: Annotated[
        list[str] | None,
        Option(
            metavar="MODULE:CLASS",
            help="Further driver of the comparison (services/experiments/PROTOCOL.md).",
        ),
    ] = None
    cells: Annotated[
        str | None,
        Option(
            metavar="NAMES",
            help=f"Cells of the comparison, comma-separated: {', '.join(CELLS)}. [default: all]",
        ),
    ] = None

    def plan(self, changes: options.Changes) -> EvaluationPlan:
        """Return the plan of the evaluation, with the changes of each trial."""
        if self.quick and self.world is not None:
            raise UsageError(
                "--quick: unsupported with --world; the evaluation of a custom "
                "world has a fixed size"
            )
        plan = PLANS["quick" if self.quick else "full"] if self.world is None else _of(self.world)
        if (self.drivers, self.driver, self.cells) != (None, None, None):
            drivers = (*_names(self.drivers or ",".join(COMPARED)), *(self.driver or ()))
            runs = TAUGHT if self.quick else COMPARED_RUNS
            plan = comparison(plan, drivers, _names(self.cells or ",".join(CELLS)), runs)
        changed = changes.other_than_taught

        def change(trial: Trial) -> Trial:
            runs = self.runs if self.runs is not None and trial.sets > 1 else trial.runs
            return replace(trial, runs=runs, sets=min(runs, trial.sets), **changed)

        return with_each(replace(plan, base=self.base or plan.base), change)


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",")]


def _of(world: str) -> EvaluationPlan:
    path = Path(world)
    aside_m = options.read_world(world).scale.aside_m
    return in_world(str(path.resolve()) if path.is_file() else world, aside_m)


def evaluate(
    *,
    out: Annotated[Path, Option(help="Folder for the results, new or begun.")],
    size: PlanSize,
    changes: options.Changes,
    at_work: options.AtWork,
    report_only: Annotated[
        bool, Option("--report-only", help="Write only the page, from finished results.")
    ] = False,
) -> None:
    """Run the paper's experiments in simulation, or compare drivers, and write a page of results.

    OUT/index.html is a self-contained page. OUT/figures holds its figures and OUT/results.json the
    numbers. The whole evaluation takes about an hour on two idle cores.

    With --drivers, --driver or --cells the command compares drivers instead: each has 50 searches
    in each cell, after five drives that teach one by one.

    The work is done in units: a drive, a model, or the searches of one driver under one condition.
    After an interruption, the same command continues with the remaining units. --report-only writes
    a page of the finished units at any time.

    Example: smal evaluate --out evaluation --quick

    Example: smal evaluate --out comparison --world indoor --driver my_driver:MyDriver
    """
    if report_only and not out.is_dir():
        raise UsageError(f"--out {out}: folder not found")
    outputs.make_folder(out, "--out")
    plan = size.plan(changes)
    planned = units(plan)
    results = Results(out, planned)
    failures = [] if report_only else _complete(results, planned, at_work)
    from services.experiments.evaluation.report.page import write_page  # noqa: PLC0415 - loads matplotlib

    typer.echo(f"results: {write_page(plan, results)}")
    if failures:
        remark(failures)
        raise JobError(
            "the results lack the searches of the drivers above; run the command again to continue"
        )


def _complete(results: Results, planned: list[Unit], at_work: options.AtWork) -> list[str]:
    with at_work.engine() as engine, closing(Bars("unit", finished=len(results.findings))) as bars:
        try:
            return results.complete(
                planned, engine, partial(bars, "units (drives, models, searches)")
            )
        except KeyboardInterrupt:
            bars.close()
            remark(["stopping; run the same command to continue"])
            raise
