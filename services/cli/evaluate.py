"""``smal evaluate``: the paper's experiments in simulation, as a page of results."""

from pathlib import Path
from typing import Annotated

import typer
from tqdm import tqdm
from typer import Option

from services.cli import options, outputs
from services.cli.interrupts import interrupted_by_signals
from services.experiments.evaluation.plan import PLANS, TAUGHT, in_world, with_runs
from services.experiments.evaluation.results import Results
from services.experiments.evaluation.units import units
from services.kit.errors import UsageError


def evaluate(
    out: Annotated[Path, Option(help="Folder for the results; where it has some already, it goes on.")],
    quick: Annotated[bool, Option(help="In some minutes: fewer drives, lengths and runs.")] = False,
    world: Annotated[
        str | None,
        Option(help="In this world instead, for example an imported map: SMAL and teach and repeat, one drive."),
    ] = None,
    runs: Annotated[
        int | None, Option(min=TAUGHT, max=1000, help=f"Searches after one drive in each cell, by {TAUGHT} drives.")
    ] = None,
    workers: Annotated[int, Option(min=1, max=64, help="Processes at work, one core each.")] = 2,
    report_only: Annotated[bool, Option("--report-only", help="Only write the page of what is done.")] = False,
) -> None:
    """Run the paper's experiments in simulation, and write a page with their figures.

    OUT/index.html shows everything and needs nothing beside it; the figures lie in OUT/figures, the numbers in
    OUT/results.json. The whole evaluation takes about an hour on two cores. It can be interrupted at any time: the
    same command goes on where it was, and while it works another one with --report-only shows what there is so far.

    Example: smal evaluate --out evaluation --quick
    """
    if report_only and not out.is_dir():
        raise UsageError(f"--out {out}: there is no such folder, and so nothing to report")
    outputs.make_folder(out, "--out")
    if quick and world is not None:
        raise UsageError("--quick: an evaluation of one's own world (--world) has one size")
    plan = PLANS["quick" if quick else "full"]
    if world is not None:
        path = Path(world)
        plan = in_world(str(path.resolve()) if path.is_file() else world, options.read_world(world).scale.aside_m)
    if runs is not None:
        plan = with_runs(plan, runs)
    planned = units(plan)
    results = Results(out, planned)
    with interrupted_by_signals():
        if not report_only:
            begun = len(results.findings)
            with tqdm(total=len(planned), initial=begun, desc="evaluating", unit="unit", dynamic_ncols=True) as bar:
                results.complete(planned, workers, bar.update)
        from services.experiments.evaluation.report.page import write_page  # noqa: PLC0415 - loads matplotlib

        page = write_page(plan, results)
    typer.echo(f"results: {page}")
