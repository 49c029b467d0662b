"""Success rates with honest error bars."""

import math
from typing import Final

#: The quantile of the normal distribution for 95 %.
_Z: Final = 1.959963984540054


def wilson_interval(successes: int, runs: int) -> tuple[float, float]:
    """Wilson's score interval of a success rate, 95 %.

    Unlike the normal approximation it stays within [0, 1] and does not shrink to a point at 0 or all successes.

    Parameters
    ----------
    successes, runs : int
        0 <= successes <= runs, runs >= 1.

    Returns
    -------
    (low, high) : floats in [0, 1]
    """
    if runs < 1 or not 0 <= successes <= runs:
        raise ValueError(f"a success rate needs 0 <= successes <= runs and runs >= 1, got {successes} of {runs}")
    rate, z2 = successes / runs, _Z * _Z
    centre = (rate + z2 / (2 * runs)) / (1 + z2 / runs)
    half = _Z * math.sqrt(rate * (1 - rate) / runs + z2 / (4 * runs * runs)) / (1 + z2 / runs)
    low = 0.0 if successes == 0 else max(0.0, centre - half)
    high = 1.0 if successes == runs else min(1.0, centre + half)
    return low, high
