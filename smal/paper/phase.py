"""The phase of a query: the frame of a template sequence at which its last frame is, as W tells it."""

import numpy as np

from smal.arrays import AnyArray
from smal.paper.state_matching import Solution

_NO_WEIGHT = 1e-9  # Share of the largest weight of a block below which a weight is rounding.


def phase(weights_block: AnyArray) -> float:
    """Template frame at which the last query frame is, from the rows (l, q) of W of the matched sequence.

    Row r with weight on query frame i says that the query is r - i frames ahead: the shift is the weighted median of
    that, since query frames beyond the template put their weight on its first or last row. Negative weights do not
    count. 0 is the first frame of the template, q - 1 no shift, more than l - 1 beyond its end.
    """
    length, queries = weights_block.shape
    present = np.maximum(weights_block, 0.0)
    largest = present.max()
    if largest == 0.0:
        return float(queries - 1)
    # Entry j is the weight of the shift j - (q - 1), that is of the phase j.
    by_phase = np.array(
        [np.trace(present / largest, -shift) for shift in range(1 - queries, length)]
    )
    phases = np.flatnonzero(by_phase > _NO_WEIGHT)
    middles = np.cumsum(by_phase[phases]) - by_phase[phases] / 2.0
    return float(np.interp(by_phase[phases].sum() / 2.0, middles, phases))


def matched_phase(solution: Solution, state: int) -> float:
    """`phase` of a solution with respect to one template sequence."""
    length = solution.sequence_length
    block = np.zeros((length, solution.shape[1]))
    inside = solution.active // length == state
    block[solution.active[inside] % length] = solution.active_weights[inside]
    return phase(block)
