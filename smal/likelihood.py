"""Likelihood of a view at a place: log p(view | here) - log p(view | elsewhere), measured on the taught drives.

A view stands out at a place by z: its cosine with the view there, less the median of its cosines with a fixed sample
of taught views, divided by their spread. Noise, darkness and another season lower all cosines and hardly change z. The
size of the map has no influence either.

*Elsewhere*, particles follow the start, the side and the turn that suit the views best. z has the distribution that it
has on the best of neighbouring wrong ways, look-alikes included. It is measured for taught views, and for mirrored
taught views, which stand for views that no drive has shown. *Here*, the right view stands out by a share of the value
between neighbouring taught views, with the scatter of a fixed wrong view; particles follow it, or a wrong way beside it
that suits better. z is then at most z0 if both are: the product of the two distribution functions. The smaller the
share, the more the right place resembles a wrong one, so that a faint match gives little evidence.

On the taught day the share is 1; under other light or behind an obstacle it is less. The share is unknown beforehand
but lasts, so the filter estimates it together with the place. With the share 0 something hides the place, and the view
gives no evidence.

Neighbouring views are not independent. They correlate by s^gamma, where s is their cosine. A view is new by
(1 - s^gamma) / (1 + s^gamma), the information of one more value of a first-order autoregression.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from smal.arrays import AnyArray, Floats
from smal.keyframes import MAP_CONFIG, MapConfig

#: Grid of z. Beyond it the values at the ends hold.
GRID = np.arange(-6.0, 40.125, 0.25)
#: Upper ends of the ranges of the share.
SHARES = np.linspace(0.0, 1.0, 5)
#: Prior probabilities of the shares.
ANY_DAY: Final = np.append(0.0, np.full(SHARES.size - 1, 1.0 / (SHARES.size - 1)))
_FINE = np.linspace(0.0, 1.0, 101)
_WIDTH = float(GRID[1] - GRID[0])
_EDGES = np.append(GRID, GRID[-1] + _WIDTH) - _WIDTH / 2.0


def scale(sample: AnyArray) -> tuple[float, float]:
    """Return the median and the spread of the cosines (n,) of a view with a sample of elsewhere.

    The spread is the median absolute deviation, scaled to the standard deviation of a normal distribution.
    """
    middle = float(np.median(sample))
    deviation = float(np.median(np.abs(sample - middle)))
    return middle, 1.4826 * deviation


def standing_out(cosines: AnyArray, sample: AnyArray) -> AnyArray:
    """Return the z values of the cosines of a view, given a sample of elsewhere; 0 for a blank view."""
    middle, spread = scale(sample)
    return over(cosines, middle, spread)


def over(cosines: AnyArray, middle: float, spread: float) -> AnyArray:
    """Return (cosines - middle) / spread; 0 if the spread is 0."""
    if spread > 1e-6:
        return (cosines - middle) / spread
    return np.zeros_like(cosines)


def log_ratio(here: Floats, elsewhere: Floats) -> Floats:
    """Return log(here / elsewhere) at each `GRID` point, made ascending by isotonic regression."""
    from scipy.optimize import isotonic_regression  # noqa: PLC0415 - only learning needs it, and it is slow to import

    ratio = np.log(np.maximum(here, 1e-300) / elsewhere)
    fitted = isotonic_regression(ratio, weights=here + elsewhere)
    return np.asarray(fitted.x, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Likelihood:
    """Log likelihood ratio as a function of z, and the correlation of neighbouring views.

    Attributes
    ----------
    log_ratio : array (shares, z)
        log p(z | here) - log p(z | elsewhere) for each of the `SHARES` at each `GRID` point, ascending.
    gamma : float
        Exponent, above 0: views of cosine s correlate by s^gamma.
    """

    log_ratio: Floats
    gamma: float

    @classmethod
    def fit(
        cls,
        here: AnyArray,
        elsewhere: AnyArray,
        followed: AnyArray,
        independent: float,
        gamma: float,
        config: MapConfig = MAP_CONFIG,
    ) -> "Likelihood":
        """Measure the likelihood on z of neighbouring taught views, and of views of different places.

        Parameters
        ----------
        here : array (n,)
            z between neighbouring taught views.
        elsewhere : array (m,)
            z between views of different places.
        followed : array (l,)
            z on the best of neighbouring wrong ways, as particles follow it.
        independent : float
            Number of independent places.
        gamma : float
        config : MapConfig
        """
        scatter = _distribution(elsewhere, independent, config.usual)
        p_followed = _distribution(followed, independent, config.usual)
        below_followed = np.cumsum(p_followed)
        zero = int(np.argmin(np.abs(GRID)))
        positive = np.maximum(here, 0.0)
        rows = np.zeros((SHARES.size, GRID.size))
        for row, least, most in zip(rows[1:], SHARES[:-1], SHARES[1:], strict=True):
            shares = _FINE[(least <= _FINE) & (most >= _FINE)]
            shown = np.multiply.outer(shares, positive).ravel()
            shown = np.clip(shown, 0.0, GRID[-1])
            counts, _ = np.histogram(shown, _EDGES)
            scattered = np.convolve(counts / shown.size, scatter)
            # The right view, or a wrong one beside it that suits better.
            below = np.cumsum(scattered[zero : zero + GRID.size]) * below_followed
            row[:] = log_ratio(np.diff(below, prepend=0.0), p_followed)
        # Any view can be hidden.
        rows = np.clip(rows, math.log(config.hidden), 50.0)
        return cls(rows, gamma)

    def of(self, z: AnyArray, share: int = -1) -> Floats:
        """Return the log ratio of each z for one of the shares."""
        return np.asarray(np.interp(z, GRID, self.log_ratio[share]))

    def mixed(self, shares: Floats, z: AnyArray, newness: float) -> Floats:
        """Return the likelihood ratio of each z, for probabilities of the shares and the newness of the view."""
        ratio = np.exp(newness * self.log_ratio)
        return np.asarray(np.interp(z, GRID, shares @ ratio))

    def correlation(self, cosine: float) -> float:
        """Return the correlation of two views of this cosine, 0 to 1."""
        limited = min(max(cosine, 0.0), 1.0)
        return math.pow(limited, self.gamma)


def _distribution(z: AnyArray, independent: float, usual: float) -> Floats:
    """Return the distribution of z over the `GRID`: a histogram up to the quantile `usual`, a fitted tail above.

    Large z are too rare to count. Excesses over a high threshold are exponential. The predictive distribution of the
    next of n such excesses, with an unknown mean, is a Pareto distribution (Lomax).
    """
    z = np.minimum(z, GRID[-1])
    threshold = float(np.quantile(z, usual))
    excess = z[z > threshold] - threshold
    mean = max(float(excess.mean()), _WIDTH) if excess.size else 1.0
    count = max((1.0 - usual) * independent, 1.0)
    counts, _ = np.histogram(z[z <= threshold], _EDGES)
    body = counts.astype(np.float64)
    beyond = np.maximum(GRID - threshold, 0.0)
    tail = (1.0 + beyond / (count * mean)) ** (-count - 1.0) * (threshold <= GRID)
    mixture = usual * body / max(body.sum(), 1.0) + (1.0 - usual) * tail / tail.sum()
    return np.convolve(mixture, [0.25, 0.5, 0.25], mode="same") + 1e-300
