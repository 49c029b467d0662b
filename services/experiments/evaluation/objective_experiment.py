"""The objective over iterations: Algorithm 2 as published, and the solver of this project, on one query."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from smal.paper.algorithm2 import algorithm2
from smal.paper.model import Model
from smal.paper.state_matching import solve

_TOLERANCES: Final = (3e-1, 1e-1, 3e-2, 1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5)
#: The paper speaks of 9, 12 and at most 20 iterations.
_ITERATIONS: Final = 40


def objectives(model: Model, views: NDArray[np.float32], template_frames: int) -> dict[str, Any]:
    """Solve Eq. 7 to ever smaller tolerances, and run Algorithm 2 beside it.

    Parameters
    ----------
    model
        Its first states are the templates: those of the first drives, which show the whole way.
    views
        (f, m) raw features of a held-out drive; the window in the middle of it is the query.
    template_frames
        At most so many; Algorithm 2 solves dense systems of them.

    Returns
    -------
    dict
        As `convergence`; and ``initial``, the objective of W = 0.
    """
    length = model.sequence_length
    end = min(len(views), len(views) // 2 + length)
    query = model.centering.apply(views)[end - length : end].T
    states = max(1, min(model.states, template_frames // length))
    templates = np.asfortranarray(model.templates[:, : states * length])
    initial = float(np.linalg.norm(query.astype(np.float64), axis=0).sum())
    return convergence(templates, query, length, (model.lambda1, model.lambda2)) | {"initial": initial}


def convergence(
    templates: NDArray[np.float32], query: NDArray[np.float32], length: int, penalties: tuple[float, float]
) -> dict[str, Any]:
    """Solve Eq. 7 to ever smaller tolerances, and run Algorithm 2 as long as it improves.

    Returns
    -------
    dict
        ``templates``, their number, and ``length``; ``ours``, a point for each tolerance with ``iterations``,
        ``objective`` and ``duality_gap``; ``algorithm2``, the objective after every iteration; ``lower_bound``, the
        best that any certificate gives.
    """
    ours, bound = [], 0.0
    for tolerance in _TOLERANCES:
        found = solve(templates, query, length, *penalties, tolerance)
        ours.append(
            {"iterations": found.iterations, "objective": found.objective, "duality_gap": float(found.duality_gap)}
        )
        bound = max(bound, found.objective * (1.0 - found.duality_gap))
    theirs = algorithm2(templates, query, length, *penalties, tolerance=1e-9, max_iterations=_ITERATIONS)
    return {
        "templates": templates.shape[1],
        "length": length,
        "ours": ours,
        "algorithm2": list(theirs.objectives),
        "lower_bound": bound,
    }
