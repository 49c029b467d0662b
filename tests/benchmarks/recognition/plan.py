"""How much the benchmark of recognition measures."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Plan:
    """Sizes of everything that is measured; the defaults are the full run.

    Parameters
    ----------
    sizes, lengths : tuple of int
        n and l of the ratios to one product.
    features : int
        m of the synthetic video.
    queries : int
        For each problem.
    repetitions : dict of int to int
        How often each query is matched, for problems of up to so many templates.
    growth_from : int
        Smallest n of the exponents.
    whole_runs : tuple of (n, l)
        Of Algorithm 2.
    one_solves : tuple of (n, l)
        Of which a single solve of Algorithm 2 is timed.
    cvxpy : tuple of (n, l)
    figure : (n, l)
        Of the convergence figure.
    episodes, recoveries : int
        Drives to render, where no recordings are given.
    """

    sizes: tuple[int, ...] = (500, 2_000, 10_000, 50_000)
    lengths: tuple[int, ...] = (1, 5, 10, 20)
    features: int = 4096
    queries: int = 5
    repetitions: dict[int, int] = field(default_factory=lambda: {2_000: 5, 10_000: 3, 10**9: 2})
    growth_from: int = 2_000
    whole_runs: tuple[tuple[int, int], ...] = ((500, 5), (500, 10), (1_000, 5), (1_000, 10))
    one_solves: tuple[tuple[int, int], ...] = ((5_000, 5), (5_000, 10))
    cvxpy: tuple[tuple[int, int], ...] = ((500, 5), (500, 10))
    figure: tuple[int, int] = (500, 10)
    episodes: int = 12
    recoveries: int = 60

    def repetitions_for(self, n: int) -> int:
        """How often a query is matched with n templates."""
        return next(times for size, times in sorted(self.repetitions.items()) if n <= size)


QUICK = Plan(
    sizes=(500, 2_000),
    queries=3,
    repetitions={10**9: 3},
    growth_from=500,
    whole_runs=((500, 5),),
    one_solves=((2_000, 5),),
    cvxpy=((500, 5),),
    episodes=2,
    recoveries=2,
)
