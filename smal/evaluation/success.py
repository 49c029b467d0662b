"""Success rates with honest error bars."""


def wilson_interval(successes: int, runs: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a success rate, 0 <= successes <= runs, runs >= 1; ValueError for others."""
    from scipy.stats import binomtest  # noqa: PLC0415 - takes a second to load, and few need it

    low, high = binomtest(successes, runs).proportion_ci(method="wilson")
    return float(low), float(high)
