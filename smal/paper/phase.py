"""Phase of a query: the frame of a template sequence that matches its last frame, by W."""

import numpy as np

from smal.arrays import AnyArray
from smal.paper.state_matching import Solution

_NO_WEIGHT = 1e-9  # Share of the largest weight of a block below which a weight is rounding.


def phase(weights_block: AnyArray) -> float:
    """Return the template frame that matches the last query frame, from the rows (l, q) of W of the matched sequence.

    Weight of row r on query frame i means that the query is r - i frames ahead. The shift is the weighted median of
    r - i, because query frames beyond the template have their weight on its first or last row. Negative weights are
    ignored. 0 is the first frame of the template, q - 1 no shift, more than l - 1 beyond its end.
    """
    length, queries = weights_block.shape
    present = np.maximum(weights_block, 0.0)
    largest = present.max()
    if largest == 0.0:
        return float(queries - 1)
    # Entry j is the weight of the shift j - (q - 1), that is of the phase j.
    shares = present / largest
    by_phase = np.array([np.trace(shares, -shift) for shift in range(1 - queries, length)])
    phases = np.flatnonzero(by_phase > _NO_WEIGHT)
    weights = by_phase[phases]
    middles = np.cumsum(weights) - weights / 2.0
    return float(np.interp(weights.sum() / 2.0, middles, phases))


def matched_phase(solution: Solution, state: int) -> float:
    """Return the `phase` of a solution with respect to one template sequence."""
    length = solution.sequence_length
    block = np.zeros((length, solution.shape[1]))
    inside = solution.active // length == state
    block[solution.active[inside] % length] = solution.active_weights[inside]
    return phase(block)
