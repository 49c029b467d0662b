"""What every format gives: drives, each a camera's frames and how fast the robot went."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from schemas.codec import printable

Array = NDArray[np.float64]
#: Most samples of a drive, or rows of a file: 28 hours at 100 Hz. They are kept in memory, 100 bytes or so each.
MOST_SAMPLES: Final = 10_000_000
#: No wheeled robot is faster.
FASTEST_M_S: Final = 50.0
FASTEST_RAD_S: Final = 100.0
#: Focal lengths over the width of the image, of fields of view from 170 to 5 degrees.
LEAST_FOCAL, MOST_FOCAL = 0.04, 12.0
#: A recording counts nanoseconds since 1970 in 63 bits: until the year 2255.
LATEST_S: Final = 9e9
#: Round the earth, whose grids some odometry begins in; and a turn every second for a year.
_FURTHEST_M: Final = 4e7
_MOST_TURNED_RAD: Final = 2e8


class ImportFailure(Exception):  # noqa: N818 - ImportError is Python's own
    """A source cannot be imported; the text names it and says why in one line."""


class NotAnImage(ValueError):  # noqa: N818 - it is caught and counted, one frame of many
    """A frame cannot be used; the text says why."""


class Frame(NamedTuple):
    """One camera image.

    Attributes
    ----------
    time_s
        When, on the source's clock.
    jpeg
        Gives the image as JPEG; only asked of frames that are used. Raises `NotAnImage`.
    """

    time_s: float
    jpeg: Callable[[], bytes]


@dataclass(frozen=True, eq=False)
class Motion:
    """How fast the robot was told to go, or went.

    Parameters
    ----------
    times_s
        (n,) ascending, on the clock of the frames.
    linear
        (n,) ahead, metres a second, or in a unit of the source's own.
    angular
        (n,) counter-clockwise, radians a second, or in a unit of the source's own.
    """

    times_s: Array
    linear: Array
    angular: Array

    @classmethod
    def of(cls, rows: list[tuple[float, float, float]], tally: Tally) -> Self:
        """Put samples (time, linear, angular) in the order of their times; what no robot does is counted instead."""
        most = (LATEST_S, FASTEST_M_S, FASTEST_RAD_S)
        return cls(
            *_sound(rows, most, "velocities are no numbers, faster than any robot, or of no time in seconds", tally).T
        )


@dataclass(frozen=True, eq=False)
class Track:
    """Where the wheels say that the robot was.

    Parameters
    ----------
    times_s
        (n,) ascending, on the clock of the frames.
    poses
        (n, 3) x and y in metres, heading in radians.
    """

    times_s: Array
    poses: Array

    @classmethod
    def of(cls, rows: list[tuple[float, float, float, float]], tally: Tally) -> Self | None:
        """Put samples (time, x, y, heading) in the order of their times; None where there are none of them."""
        values = _sound(rows, (LATEST_S, _FURTHEST_M, _FURTHEST_M, _MOST_TURNED_RAD), "poses are nowhere", tally)
        return cls(values[:, 0], values[:, 1:]) if len(values) else None


def _sound(rows: Sequence[tuple[float, ...]], most: tuple[float, ...], what: str, tally: Tally) -> Array:
    """Return the rows whose numbers are not beyond the most that they can be, in the order of the first."""
    values = np.array(rows, dtype=np.float64).reshape(-1, len(most))
    sound = (np.abs(values) <= most).all(axis=1)
    tally.count(what, int((~sound).sum()))
    values = values[sound]
    found: Array = values[np.argsort(values[:, 0], kind="stable")]
    return found


@dataclass(frozen=True, eq=False)
class Drive:
    """One drive of a source.

    Parameters
    ----------
    name
        As the source calls it.
    motion
        What atoms are made of.
    frames
        Gives the frames in the order of their times, each time anew.
    count
        How many frames there are, for a progress bar.
    track
        Odometry, where the source has some.
    success
        Whether it reached its goal; None where the source does not say.
    focal
        Focal length of the camera over the width of its image, where the source says it.
    """

    name: str
    motion: Motion
    frames: Callable[[], Iterator[Frame]]
    count: int
    track: Track | None = None
    success: bool | None = None
    focal: float | None = None


@dataclass(frozen=True, eq=False)
class Source:
    """What a format's reader makes of a path.

    Parameters
    ----------
    drives
        All of it.
    metric
        Whether velocities are in metres and radians a second, so that a way can be reckoned from them.
    """

    drives: list[Drive]
    metric: bool


@dataclass
class Tally:
    """Counts what does not fit.

    Attributes
    ----------
    counts
        How often, by what is said of it.
    remarks
        What is said once.
    """

    counts: Counter[str] = field(default_factory=Counter)
    remarks: list[str] = field(default_factory=list)

    def count(self, what: str, times: int = 1) -> None:
        """Count something, for example "images that are damaged"."""
        if times:
            self.counts[printable(what)] += times

    def say(self, remark: str) -> None:
        """Say something once."""
        if remark not in self.remarks:
            self.remarks.append(remark)

    def counted(self) -> list[str]:
        """Return what was counted."""
        return [f"{times} {what}" for what, times in self.counts.items()]

    def lines(self) -> list[str]:
        """Return all that is to be said."""
        return [*self.remarks, *self.counted()]
