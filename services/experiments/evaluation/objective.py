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
    """Compare both on the window in the middle of a held-out drive, of whose views (f, m) are the raw features.

    The model's first states are the templates, those of the first drives, which show the whole way: at most so many
    frames, since Algorithm 2 solves dense systems of them. The answer is that of `convergence`, and ``initial``, the
    objective of W = 0.
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
        best that any duality gap proves.
    """
    found = [solve(templates, query, length, *penalties, tolerance) for tolerance in _TOLERANCES]
    theirs = algorithm2(templates, query, length, *penalties, tolerance=1e-9, max_iterations=_ITERATIONS)
    return {
        "templates": templates.shape[1],
        "length": length,
        "ours": [{"iterations": one.iterations, "objective": one.objective, "duality_gap": float(one.duality_gap)}
                 for one in found],
        "algorithm2": list(theirs.objectives),
        "lower_bound": max(one.objective * (1.0 - one.duality_gap) for one in found),
    }  # fmt: skip
