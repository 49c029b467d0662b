"""The objective over iterations: Algorithm 2 as published, and the solver of this project, on one query."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from services.experiments.colours import COLOURS, MUTED
from services.experiments.drawing import styled
from smal.paper.state_matching import solve
from tests.benchmarks.recognition.algorithm2 import algorithm2

OURS, THEIRS = COLOURS[:2]

_TOLERANCES: Final = (3e-1, 1e-1, 3e-2, 1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5)
_ITERATIONS: Final = 40  # The paper speaks of 9, 12 and at most 20 iterations.


def convergence(
    templates: NDArray[np.float32],
    query: NDArray[np.float32],
    length: int,
    penalties: tuple[float, float],
) -> dict[str, Any]:
    """Solve Eq. 7 to ever smaller tolerances, and run Algorithm 2 as long as it improves.

    Returns
    -------
    dict
        ``templates``, their number, and ``length``; ``ours``, a point for each tolerance with ``iterations``,
        ``objective`` and ``duality_gap``; ``algorithm2``, the objective after every iteration; ``lower_bound``, the
        best that any duality gap proves.
    """
    found = [solve(templates, query, length, *penalties, tolerance) for tolerance in _TOLERANCES]
    theirs = algorithm2(
        templates, query, length, *penalties, tolerance=1e-9, max_iterations=_ITERATIONS
    )
    return {
        "templates": templates.shape[1],
        "length": length,
        "ours": [{"iterations": one.iterations, "objective": one.objective, "duality_gap": float(one.duality_gap)}
                 for one in found],
        "algorithm2": list(theirs.objectives),
        "lower_bound": max(one.objective * (1.0 - one.duality_gap) for one in found),
    }  # fmt: skip


@styled
def objective_figure(found: Mapping[str, dict[str, Any]]) -> Figure:
    """Draw Eq. 7 over the iterations of Algorithm 2 and of this project's solver; the gap to the optimum below."""
    drawn = Figure(figsize=(5.4 * len(found), 7.0))
    panels = drawn.subplots(2, len(found), squeeze=False, sharex="col")
    for column, (world, one) in enumerate(found.items()):
        upper, lower = panels[:, column]
        theirs = np.array(one["algorithm2"])
        bound = one["lower_bound"]
        ours = [point for point in one["ours"] if point["iterations"] > 0]
        steps, values, gaps = (
            [point[name] for point in ours] for name in ("iterations", "objective", "duality_gap")
        )
        after = np.arange(1, theirs.size + 1)
        upper.plot(after, theirs, ".-", color=THEIRS, label="Algorithm 2 as published")
        upper.plot(steps, values, "o-", color=OURS, label="this project's solver")
        upper.axhline(bound, color=MUTED, ls="--", lw=1.0, label="proven lower bound")
        upper.set(ylabel="objective (Eq. 7)")
        upper.set_title(f"{world}: {one['templates']:,} template frames, l = {one['length']}")
        lower.axvspan(
            9, 12, color=MUTED, alpha=0.15, lw=0.0, label="the paper: 9 and 12 iterations"
        )
        lower.semilogy(after, np.maximum((theirs - bound) / theirs, 1e-9), ".-", color=THEIRS)
        lower.semilogy(steps, np.maximum(gaps, 1e-9), "o-", color=OURS)
        lower.axhline(1e-4, color=MUTED, ls=":", lw=1.2)
        lower.axvline(20, color=MUTED, ls=":", lw=1.2, label="the paper: below 1e-4 within 20")
        lower.set(xlabel="iterations", ylabel="relative gap to the optimum", xlim=(0, None))
        for axes in (upper, lower):
            axes.legend()
    return drawn
