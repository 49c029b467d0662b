"""Distance to the target, from its size and its height in the view, calibrated on the approach.

The wheels measure how far each view of the approach is from the end of the drive. The size of the
target, and for a level camera its distance from the horizon, fall with the distance to the target.
The approach shows how well each of them does so: a target on the horizon has a large error in height.
"""

import math
from dataclasses import astuple, dataclass
from typing import Final

import numpy as np

from smal.arrays import Floats

#: Error of an estimate without information.
_UNKNOWN: Final = 1e3


@dataclass(frozen=True)
class Distance:
    """Calibration of the distance to the target; errors are of logarithms."""

    #: Distance from the end of the drive to the target, in seconds of driving.
    end_s: float
    #: Size, and height below the middle, of the target in a view at the end of the drive.
    size: float
    low: float
    size_error: float
    low_error: float

    def __post_init__(self) -> None:
        """Raise ValueError if a number is out of range: they can come from a file."""
        numbers = astuple(self)
        if not all(0.0 < number <= _UNKNOWN for number in numbers):
            raise ValueError("the parts of the target do not fit together: distance")

    @classmethod
    def fit(cls, left_s: Floats, sizes: Floats, lows: Floats, usual_s: float) -> "Distance":
        """Calibrate on the views of the approach (n,), `left_s` seconds of driving before the end.

        Few views hardly show the distance from the end to the target, so that it has a wide
        distribution around `usual_s`. Errors are as if a further view of an error of a half were there.
        """
        ends_s = usual_s * np.geomspace(0.2, 5.0, 49)
        away = np.log(ends_s[:, None] + left_s)
        residuals = np.log(sizes) + away
        spread = residuals.var(axis=1) * len(sizes)
        errors = np.sqrt((spread + 0.25) / len(sizes))
        best = int(np.argmin(len(sizes) * np.log(errors) + np.log(ends_s / usual_s) ** 2 / 2.0))
        end = math.log(ends_s[best])
        size = float(np.exp(residuals[best].mean() - end))
        low = 1.0
        low_error = _UNKNOWN
        if (lows > 0.0).all():
            heights = np.log(lows) + away[best]
            low = float(np.exp(heights.mean() - end))
            low_error = math.sqrt((heights.var() * len(lows) + 0.25) / len(lows))
        return cls(float(ends_s[best]), size, low, float(errors[best]), low_error)

    def log_near(self, size: float, low: float) -> tuple[float, float]:
        """Return the log of the distance at the end over the distance now, and its error."""
        by_size = math.log(size / self.size), self.size_error
        if low <= 0.0:
            return by_size
        return combined(by_size, (math.log(low / self.low), self.low_error))

    def log_near_of_place(self, left_s: float, error_s: float) -> tuple[float, float]:
        """Return the same for a robot that is `left_s` before the end of the drive.

        The target can have been moved by half of its distance.
        """
        away_s = self.end_s + left_s
        error = math.hypot(error_s, self.end_s / 2.0) / away_s
        return math.log(self.end_s / away_s), error


def combined(*estimates: tuple[float, float]) -> tuple[float, float]:
    """Combine estimates and their standard deviations by inverse variances."""
    values, errors = np.array(estimates).T
    weights = errors**-2.0
    total = float(weights.sum())
    return float(weights @ values) / total, total**-0.5
