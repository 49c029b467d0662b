"""Drive of a foreign recording in any format: camera frames, velocities, poses."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from schemas.codec import printable
from services.kit.errors import JobError
from smal.camera import Camera

Array = NDArray[np.float64]
#: Maximum samples of a drive or rows of a file: 28 hours at 100 Hz, 100 bytes each.
MOST_SAMPLES: Final = 10_000_000
#: Names of the numbers of a pose by odometry.
POSE: Final = ("x_m", "y_m", "heading_rad")
# Maximum speed of wheeled robots.
FASTEST_M_S = 50.0
FASTEST_RAD_S = 100.0
LATEST_S: Final = 9e9  # The year 2255: recordings count nanoseconds since 1970 in 63 bits.
_FURTHEST_M: Final = 4e7  # The circumference of the earth: some odometry uses geographic grids.
_MOST_TURNED_RAD: Final = 2e8  # A turn every second for a year.

_APART_S: Final = 1.5  # Times closer than this are one span of a report.
_TENTH_S: Final = 0.1
_MOST_SPANS: Final = 3


class ImportFailure(JobError):  # noqa: N818 - ImportError is Python's own
    """Raised when a source cannot be imported; the text has its name and the reason in one line."""


class NotAnImage(ValueError):  # noqa: N818 - it is caught and counted, one frame of many
    """Raised when a frame cannot be used; the text is the reason."""


#: Returns a frame as JPEG, or raises `NotAnImage`; called only for frames in use.
Image = Callable[[], bytes]
Images = Callable[[], Iterator[Image]]
Rows = Sequence[tuple[float, ...]] | Array
#: Reads of the drives of a source by their name, or by the start of their names.
Reads = dict[str, Callable[[], "list[ImportedDrive]"]]


@dataclass(frozen=True, eq=False)
class ImportedDrive:
    """One drive of a source; all times are on one clock, in seconds."""

    name: str  # Name in the source.
    times_s: Array  # (n,) of the frames.
    images: Images  # The n frames in order; each call returns new ones.
    #: (k, 3) time, speed ahead, turn rate counter-clockwise, ascending; of the track if empty.
    motion: Array
    #: (m, 4) time, x and y in metres, heading in radians, ascending: poses by odometry.
    track: Array = field(default_factory=lambda: np.zeros((0, 4)))
    success: bool | None = None  # Whether it reached its goal; None if unknown.
    #: (l, 3) time, speed ahead, turn rate, ascending: velocities that the odometry reports.
    twist: Array = field(default_factory=lambda: np.zeros((0, 3)))
    camera: Camera | None = None  # None if unknown.
    #: Factor of the turn rates of the source; None if they are computed from poses.
    turn_rate: float | None = 1.0
    metric: bool = True  # Whether velocities are in metres and radians per second.
    reckoned: bool = False  # Whether the track is computed from the velocities.

    @property
    def called(self) -> str:
        """Name of the drive in a report."""
        return f"drive {printable(self.name)}" if self.name else "the drive"

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
        """Create a drive from rows of motion and track in any order; count implausible rows."""
        furthest = (LATEST_S, _FURTHEST_M, _FURTHEST_M, _MOST_TURNED_RAD)
        where = _sound(track, furthest, "poses are not finite or too far away", tally)
        return cls(name, times_s, images, motion_of(motion, tally), where, **more)

    def without(self, at_s: float, pause_s: float) -> Self:
        """Return the drive with all times after a moment earlier by a pause."""

        def earlier(rows: Array) -> Array:
            moved = rows.copy()
            moved[rows[:, 0] > at_s, 0] -= pause_s
            return moved

        return replace(
            self,
            times_s=earlier(self.times_s[:, None])[:, 0],
            motion=earlier(self.motion),
            track=earlier(self.track),
            twist=earlier(self.twist),
        )


@dataclass
class Tally:
    """Counts defects of a source, and collects remarks."""

    counts: Counter[str] = field(default_factory=Counter)  # By the text of the defect.
    remarks: list[str] = field(default_factory=list)
    _first: set[str] = field(default_factory=set)  # Subjects with a remark.

    def count(self, what: str, times: int = 1) -> None:
        """Count a defect, for example "images that are damaged"."""
        if times:
            self.counts[printable(what)] += times

    def say(self, remark: str) -> None:
        """Add a remark once."""
        if remark not in self.remarks:
            self.remarks.append(remark)

    def say_first(self, subject: str, remark: str) -> None:
        """Add a remark if it is the first on a subject."""
        if subject not in self._first:
            self._first.add(subject)
            self.say(remark)

    def say_all(self, what: str, places: list[str]) -> None:
        """Add a remark on all places where something is so, if any."""
        if places:
            more = f" and {len(places) - _MOST_SPANS} more" if len(places) > _MOST_SPANS else ""
            self.say(f"{what} {', '.join(places[:_MOST_SPANS])}{more}")

    def counted(self) -> list[str]:
        """Return the counted defects, one per line."""
        return [f"{times} {what}" for what, times in self.counts.items()]

    def lines(self) -> list[str]:
        """Return the remarks and the counted defects, one per line."""
        return [*self.remarks, *self.counted()]


def spans(times_s: Array) -> list[str]:
    """Return the spans of times as text, such as ``3.0 to 5.1 s``."""
    parts = np.split(times_s, np.flatnonzero(np.diff(times_s) > _APART_S) + 1)
    return [
        f"{part[0]:.1f} s"
        if part[-1] - part[0] < _TENTH_S
        else f"{part[0]:.1f} to {part[-1]:.1f} s"
        for part in parts
    ]


def motion_of(rows: Rows, tally: Tally) -> Array:
    """Return (time, speed, turn rate) by time, (k, 3); count implausible rows."""
    wrong = "velocities are invalid: not numbers, faster than any robot, or at times not in seconds"
    return _sound(rows, (LATEST_S, FASTEST_M_S, FASTEST_RAD_S), wrong, tally)


def _sound(rows: Rows, most: tuple[float, ...], what: str, tally: Tally) -> Array:
    values = np.array(rows, dtype=np.float64).reshape(-1, len(most))
    sound = (np.abs(values) <= most).all(axis=1)
    tally.count(what, int((~sound).sum()))
    values = values[sound]
    found: Array = values[np.argsort(values[:, 0], kind="stable")]
    return found
