"""How much a view speaks for a place: log p(view | here) - log p(view | elsewhere), measured on what was taught.

A view stands out at a place by z: its cosine with the view from there, less the median of its cosines with a fixed
sample of taught views, over their spread. So noise, darkness and another season, which make all cosines small, change z
little, and the size of the map does not enter.

*Elsewhere* z is distributed as it is between taught views of different places, look-alikes included. *Here* a view
stands out by a share of what it did between neighbouring taught views, with the scatter of elsewhere: on the taught day
by all of it, under other light or behind something by less. Nobody knows the share beforehand, but it lasts: the filter
follows it as it follows the place. With the share 0 something hides the place, and a view says nothing.

Neighbouring views are no independent witnesses. They correlate by s^gamma, where s is their cosine; a view is new by
(1 - s^gamma) / (1 + s^gamma), which is what one more value of a first-order autoregression tells.
"""

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from smal.keyframes import MAP_CONFIG, MapConfig

GRID = np.arange(-6.0, 40.125, 0.25)  # What z is tabulated for; beyond it the ends hold.
SHARES = np.linspace(0.0, 1.0, 5)  # Upper ends of the ranges of the share.
#: Their probabilities on a day of which nothing is known.
ANY_DAY: Final = np.append(0.0, np.full(SHARES.size - 1, 1.0 / (SHARES.size - 1)))
_FINE = np.linspace(0.0, 1.0, 101)


def evenly(count: int, most: int) -> NDArray[np.intp]:
    """Return at most so many of the numbers below a count, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.intp))


def scale(sample: NDArray[Any]) -> tuple[float, float]:
    """Return the median of the cosines (n,) of a view with a sample of elsewhere, and their spread.

    The spread is the median absolute deviation, scaled to the standard deviation of a normal distribution.
    """
    middle = float(np.median(sample))
    return middle, 1.4826 * float(np.median(np.abs(sample - middle)))


def standing_out(cosines: NDArray[Any], sample: NDArray[Any]) -> NDArray[Any]:
    """Return by how much the cosines of a view stand out from those with a sample of elsewhere; 0 if it is blank."""
    return over(cosines, *scale(sample))


def over(cosines: NDArray[Any], middle: float, spread: float) -> NDArray[Any]:
    """Return cosines less the middle, over the spread; 0 where there is none."""
    return (cosines - middle) / spread if spread > 1e-6 else np.zeros_like(cosines)


def log_ratio(here: NDArray[np.float64], elsewhere: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return log(here / elsewhere) at each `GRID` point, ascending: what stands out more never speaks less."""
    from scipy.optimize import isotonic_regression  # noqa: PLC0415 - only learning needs it, and it is slow to import

    ratio = np.log(np.maximum(here, 1e-300) / elsewhere)
    return np.asarray(isotonic_regression(ratio, weights=here + elsewhere).x, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Likelihood:
    """The log ratio for each z, and how fast views become new.

    `log_ratio` (shares, z) is log p(z | here) - log p(z | elsewhere) for each of the `SHARES` at each `GRID` point,
    ascending; neighbouring views correlate by their cosine to the power `gamma`, above 0.
    """

    log_ratio: NDArray[np.float64]
    gamma: float

    @classmethod
    def fit(
        cls,
        here: NDArray[Any],
        elsewhere: NDArray[Any],
        independent: float,
        gamma: float,
        config: MapConfig = MAP_CONFIG,
    ) -> "Likelihood":
        """Measure it on z of neighbouring taught views, and of views of different places.

        `independent` says how many of the latter are independent.
        """
        width = GRID[1] - GRID[0]
        edges = np.append(GRID, GRID[-1] + width) - width / 2.0
        # Too few views stand out by much to be counted. Excesses over a high threshold are exponential; what n of them
        # let expect of the next one, whose mean is not known, is a Pareto distribution (Lomax).
        elsewhere = np.minimum(elsewhere, GRID[-1])
        threshold = float(np.quantile(elsewhere, config.usual))
        above = elsewhere[elsewhere > threshold] - threshold
        mean = max(float(above.mean()), width) if above.size else 1.0
        count = max((1.0 - config.usual) * independent, 1.0)
        usual = np.histogram(elsewhere[elsewhere <= threshold], edges)[0].astype(np.float64)
        tail = (1.0 + np.maximum(GRID - threshold, 0.0) / (count * mean)) ** (-count - 1.0) * (
            threshold <= GRID
        )
        p0 = config.usual * usual / max(usual.sum(), 1.0) + (1.0 - config.usual) * tail / tail.sum()
        p0 = np.convolve(p0, [0.25, 0.5, 0.25], mode="same") + 1e-300
        zero = int(np.argmin(np.abs(GRID)))
        rows = np.zeros((SHARES.size, GRID.size))
        for row, least, most in zip(rows[1:], SHARES[:-1], SHARES[1:], strict=True):
            shares = _FINE[(least <= _FINE) & (most >= _FINE)]
            shown = np.clip(np.multiply.outer(shares, np.maximum(here, 0.0)).ravel(), 0.0, GRID[-1])
            p1 = np.convolve(np.histogram(shown, edges)[0] / shown.size, p0)[
                zero : zero + GRID.size
            ]
            row[:] = log_ratio(p1, p0)
        # Any view may be hidden.
        return cls(np.clip(rows, math.log(config.hidden), 50.0), gamma)

    def of(self, z: NDArray[Any], share: int = -1) -> NDArray[np.float64]:
        """Return the log ratio of each z, for one of the shares."""
        return np.asarray(np.interp(z, GRID, self.log_ratio[share]))

    def mixed(
        self, shares: NDArray[np.float64], z: NDArray[Any], newness: float
    ) -> NDArray[np.float64]:
        """Return the likelihood ratio of each z where shares have these probabilities, of a view that is so new."""
        return np.asarray(np.interp(z, GRID, shares @ np.exp(newness * self.log_ratio)))

    def correlation(self, cosine: float) -> float:
        """Return how far two views of this cosine say the same, 0 to 1."""
        return math.pow(min(max(cosine, 0.0), 1.0), self.gamma)
