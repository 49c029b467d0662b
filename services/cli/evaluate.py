"""``smal evaluate``: the paper's experiments in simulation, or laps of a real robot, as a page of results."""

from contextlib import closing
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from services.cli import options, outputs
from services.experiments.evaluation.plan import PLANS, TAUGHT, in_world, with_each
from services.experiments.evaluation.results import Results
from services.experiments.evaluation.units import units
from services.experiments.progress import Bars
from services.experiments.words import remark
from services.kit.errors import UsageError


def evaluate(
    *,
    out: Annotated[
        Path, Option(help="Folder for the results; where it has some already, it goes on.")
    ],
    quick: Annotated[
        bool, Option(help="Fewer drives, lengths and runs: 5 to 10 minutes on two idle cores.")
    ] = False,
    world: Annotated[
        str | None, Option(help="In this one instead: SMAL and teach and repeat, one drive.")
    ] = None,
    runs: Annotated[
        int | None, Option(min=TAUGHT, max=1000, help=f"Searches, shared by {TAUGHT} drives.")
    ] = None,
    changes: options.Changes,
    base: options.Base = None,
    laps: Annotated[
        Path | None, Option(metavar="SOURCE", help="Of a real robot: laps in a tub or recordings.")
    ] = None,
    at_work: options.AtWork,
    report_only: Annotated[
        bool, Option("--report-only", help="Only write the page of what is done.")
    ] = False,
) -> None:
    """Run the paper's experiments in simulation, and write a page with their figures.

    OUT/index.html shows everything and needs nothing beside it; the figures lie in OUT/figures, the numbers in
    OUT/results.json. The whole evaluation takes about an hour on two idle cores. It is done in units: a drive, a model,
    or the searches of one driver under one condition. It can be interrupted at any time: the same command goes on with
    the units that are not done, and while it works another one with --report-only shows what there is so far.

    With --laps nothing is simulated: one lap teaches SMAL, which is asked where it is on all others, with and without
    odometry, beside the nearest taught frame and teach and repeat. It needs three whole laps, which are found where
    views recur, and takes some minutes.

    Example: smal evaluate --out evaluation --quick

    Example: smal evaluate --out laps --laps tub
    """
    if laps is not None:
        given = {
            "quick": quick,
            "world": world,
            "runs": runs,
            "base": base,
            "report-only": report_only,
        }
        given |= asdict(changes)
        for option, value in given.items():
            if value not in (None, 0, "there"):
                raise UsageError(
                    f"--{option}: laps of a real robot (--laps) have one size, and no world"
                )
        typer.echo(f"results: {_evaluate_laps(laps, out)}")
        return
    if report_only and not out.is_dir():
        raise UsageError(f"--out {out}: there is no such folder, and so nothing to report")
    outputs.make_folder(out, "--out")
    if quick and world is not None:
        raise UsageError("--quick: an evaluation of one's own world (--world) has one size")
    plan = PLANS["quick" if quick else "full"]
    if world is not None:
        path = Path(world)
        plan = in_world(
            str(path.resolve()) if path.is_file() else world,
            options.read_world(world).scale.aside_m,
        )
    if runs is not None:
        plan = with_each(plan, lambda trial: replace(trial, runs=runs) if trial.sets > 1 else trial)
    changed = {name: value for name, value in asdict(changes).items() if value not in (0, "there")}
    plan = with_each(replace(plan, base=base or plan.base), lambda trial: replace(trial, **changed))
    planned = units(plan)
    results = Results(out, planned)
    if not report_only:
        with at_work.engine() as engine, closing(Bars("unit")) as bars:
            try:
                results.complete(planned, engine, partial(bars, "units (drives, models, searches)"))
            except KeyboardInterrupt:
                bars.close()
                remark(["stopping; the same command goes on from here"])
                raise
    from services.experiments.evaluation.report.page import write_page  # noqa: PLC0415 - loads matplotlib

    page = write_page(plan, results)
    typer.echo(f"results: {page}")


def _evaluate_laps(source: Path, out: Path) -> Path:
    """Find the laps, teach on the one in the middle, ask on all others and write the page; return it."""
    from services.experiments.laps.asking import ask  # noqa: PLC0415 - what follows loads much
    from services.experiments.laps.report import write_page  # noqa: PLC0415
    from services.experiments.laps.source import read_laps  # noqa: PLC0415

    with closing(Bars()) as bar:
        laps = read_laps(source, bar)
        outputs.make_folder(out, "--out")
        judged = ask(laps, bar)
    return write_page(out, source, laps, judged)
