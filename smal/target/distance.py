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
#: Squared error of the view that calibration adds to the views of the approach.
_PRIOR: Final = 0.25


@dataclass(frozen=True)
class Distance:
    """Calibration of the distance to the target; errors are of logarithms."""

    #: Distance from the end of the drive to the target, in seconds of driving.
    end_s: float
    #: Size of the target at the end of the drive, and the power of the distance that it falls with:
    #: below 1, because a small target still covers a whole cell.
    size: float
    power: float
    size_error: float
    #: Height of the target there, below the middle of the view or above.
    low: float
    low_error: float

    def __post_init__(self) -> None:
        """Raise ValueError if a number is out of range: they can come from a file."""
        end_s, size, power, size_error, low, low_error = astuple(self)
        positive = (end_s, size, power, size_error, abs(low), low_error)
        if not all(0.0 < number <= _UNKNOWN for number in positive):
            raise ValueError("the parts of the target do not fit together: distance")

    @classmethod
    def fit(cls, left_s: Floats, sizes: Floats, lows: Floats, usual_s: float) -> "Distance":
        """Calibrate on the views of the approach (n,), `left_s` seconds of driving before the end.

        The height gives the distance from the end to the target, which is about `usual_s` if there
        are few views. Errors are as if a further view had an error of a half.
        """
        count = len(sizes)
        ends_s = usual_s * np.geomspace(0.2, 5.0, 65)
        away = np.log1p(left_s / ends_s[:, None])
        unlikely = np.log(ends_s / usual_s) ** 2 / 2.0
        low = _UNKNOWN
        low_error = _UNKNOWN
        if abs(np.sign(lows).sum()) == count:
            heights = np.log(np.abs(lows)) + away
            errors = np.sqrt((heights.var(axis=1) * count + _PRIOR) / count)
            unlikely += count * np.log(errors)
            best = int(unlikely.argmin())
            low = float(np.sign(lows[0]) * np.exp(heights[best].mean()))
            low_error = float(errors[best])
        best = int(unlikely.argmin())
        from_mean = away[best] - away[best].mean()
        falls = float(-from_mean @ np.log(sizes) + _PRIOR)
        power = float(np.clip(falls / (from_mean @ from_mean + _PRIOR), 0.2, 1.0))
        size = np.log(sizes) + power * away[best]
        size_error = math.sqrt((size.var() * count + _PRIOR) / count) / power
        at_end = float(np.exp(size.mean()))
        return cls(float(ends_s[best]), at_end, power, size_error, low, low_error)

    def log_near(self, size: float, low: float) -> tuple[float, float]:
        """Return the log of the distance at the end over the distance now, and its error."""
        by_size = math.log(size / self.size) / self.power, self.size_error
        if low * self.low <= 0.0:
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
