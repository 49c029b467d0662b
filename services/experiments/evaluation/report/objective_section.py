"""The part of the report about the objective: how fast Algorithm 2 and this project's solver reach the optimum."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from services.experiments import html
from services.experiments.evaluation.report import recognition_figures as figures
from services.experiments.evaluation.report.embedding import EmbeddedFigures
from services.experiments.evaluation.report.summary import Results


def objective_section(found: Sequence[Results], put: EmbeddedFigures) -> Iterator[str]:
    """Write it as HTML, piece by piece; nothing where nobody measured it."""
    each = {one.world.title: one.objective for one in found if one.objective is not None}
    if not each:
        return
    yield "<h2>Objective value over iterations</h2>"
    yield put(
        "objective",
        figures.objective(each),
        "Eq. 7 on one held-out query, after every iteration of Algorithm 2 as published and of this project's solver "
        "(one point for each tolerance, with its own certificate), as in the paper's figures of the objective value. "
        "Below: how far above the optimum, at most. The paper reports 9 and 12 iterations. An iteration of Algorithm 2 "
        "solves dense systems of all template frames, one of ours a small one of those that have a weight.",
    )
    rows = []
    for world, one in each.items():
        within = next((k for k, value in enumerate(one["algorithm2"], 1)
                       if (value - one["lower_bound"]) / value <= 1e-3), None)  # fmt: skip
        ours = next((point for point in one["ours"] if point["duality_gap"] <= 1e-3), None)
        rows.append([
            world, f"{one['templates']:,}", f"{one['initial']:.4f}", f"{one['lower_bound']:.6f}",
            f"{one['algorithm2'][-1]:.6f}", "never" if within is None else str(within),
            "never" if ours is None else str(ours["iterations"]),
        ])  # fmt: skip
    head = ["world", "template frames", "at W = 0", "lower bound", "Algorithm 2, last", "its iterations to 1e-3",
            "ours to 1e-3"]  # fmt: skip
    yield html.table(head, rows, left=1)
