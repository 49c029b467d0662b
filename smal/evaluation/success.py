"""Success rates with honest error bars."""


def wilson_interval(successes: int, runs: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval (low, high) of a success rate, for 0 <= successes <= runs, runs >= 1.

    It stays within [0, 1] and does not shrink to a point at 0 or all successes. ValueError for other counts.
    """
    from scipy.stats import binomtest  # noqa: PLC0415 - takes a second to load, and few need it

    low, high = binomtest(successes, runs).proportion_ci(method="wilson")
    return float(low), float(high)
