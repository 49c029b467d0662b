"""What every format gives: drives, each a camera's frames and how fast the robot went."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from schemas.codec import printable
from services.kit.errors import JobError
from smal.camera import Camera

Array = NDArray[np.float64]
MOST_SAMPLES: Final = (
    10_000_000  # Most of a drive, or rows of a file: 28 hours at 100 Hz, 100 bytes each.
)
# No wheeled robot is faster.
FASTEST_M_S = 50.0
FASTEST_RAD_S = 100.0
LATEST_S: Final = 9e9  # A recording counts nanoseconds since 1970 in 63 bits: until the year 2255.
_FURTHEST_M: Final = 4e7  # Round the earth, whose grids some odometry begins in.
_MOST_TURNED_RAD: Final = 2e8  # A turn every second for a year.


class ImportFailure(JobError):  # noqa: N818 - ImportError is Python's own
    """A source cannot be imported; the text names it and says why in one line."""


class NotAnImage(ValueError):  # noqa: N818 - it is caught and counted, one frame of many
    """A frame cannot be used; the text says why."""


Image = Callable[
    [], bytes
]  # Gives one frame as JPEG, or raises `NotAnImage`; only asked of frames that are used.
Images = Callable[[], Iterator[Image]]
Rows = Sequence[tuple[float, ...]] | Array


@dataclass(frozen=True, eq=False)
class ImportedDrive:
    """One drive of a source; all times are on the same clock, in seconds."""

    name: str  # As the source calls it.
    times_s: Array  # (n,) of the frames.
    images: Images  # Gives the n frames in their order, each time anew.
    motion: Array  # (k, 3) time, speed ahead, turn rate counter-clockwise, ascending: what atoms are made of.
    #: (m, 4) time, x and y in metres, heading in radians, ascending: where the wheels say that the robot was.
    track: Array = field(default_factory=lambda: np.zeros((0, 4)))
    success: bool | None = None  # Whether it reached its goal; None where the source does not say.
    camera: Camera | None = None  # How it sees, where the source says it.
    metric: bool = True  # Whether velocities are metres and radians a second, so that a way can be reckoned from them.

    @classmethod
    def of_rows(
        cls,
        name: str,
        times_s: Array,
        images: Images,
        motion: Rows,
        track: Rows,
        tally: "Tally",
        **more: Any,  # noqa: ANN401
    ) -> Self:
        """Make a drive of rows in any order, of motion and of track; what no robot does is counted instead."""
        furthest = (LATEST_S, _FURTHEST_M, _FURTHEST_M, _MOST_TURNED_RAD)
        where = _sound(track, furthest, "poses are nowhere", tally)
        return cls(name, times_s, images, motion_of(motion, tally), where, **more)


@dataclass
class Tally:
    """Counts what does not fit."""

    counts: Counter[str] = field(default_factory=Counter)  # How often, by what is said of it.
    remarks: list[str] = field(default_factory=list)  # What is said once.

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


def motion_of(rows: Rows, tally: Tally) -> Array:
    """Return (time, speed, turn rate) in the order of time, (k, 3); what no robot does is counted instead."""
    said = "velocities are no numbers, faster than any robot, or of no time in seconds"
    return _sound(rows, (LATEST_S, FASTEST_M_S, FASTEST_RAD_S), said, tally)


def _sound(rows: Rows, most: tuple[float, ...], what: str, tally: Tally) -> Array:
    values = np.array(rows, dtype=np.float64).reshape(-1, len(most))
    sound = (np.abs(values) <= most).all(axis=1)
    tally.count(what, int((~sound).sum()))
    values = values[sound]
    found: Array = values[np.argsort(values[:, 0], kind="stable")]
    return found
