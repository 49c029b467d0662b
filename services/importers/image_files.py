"""Drives whose frames are image files in a folder, and whose rows say when each was taken."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Final, NamedTuple

import numpy as np

from services.importers.drive import Array, Drive, ImportFailure, NotAnImage, Tally, motion_of, track_of
from services.importers.images import MOST_BYTES, as_jpeg
from services.importers.inside import Inside

#: No camera of a robot is faster; then the times are those of copying the data set.
_FASTEST_HZ: Final = 120.0
_UNREAD: Final = "images cannot be read"


class Row(NamedTuple):
    """A frame: its file, when it was taken, speed ahead and turn rate, and where the wheels say that the robot was."""

    image: str
    time_s: float
    velocity: tuple[float, float]
    pose: tuple[float, float, float] | None = None


def drive_of(
    inside: Inside, name: str, rows: Sequence[Row], tally: Tally, *, success: bool | None = None, metric: bool = True
) -> Drive:
    """Make a drive of its frames.

    Raises
    ------
    ImportFailure
        When no camera's frames have such times: the ticks would show nothing of how the robot drove.
    """
    times_s = np.array([row.time_s for row in rows])
    _check_rate(times_s, inside)
    return Drive(
        name,
        times_s,
        lambda: (partial(_image, inside, row.image, tally) for row in rows),
        motion_of([(row.time_s, *row.velocity) for row in rows], tally),
        track_of([(row.time_s, *row.pose) for row in rows if row.pose is not None], tally),
        success=success,
        metric=metric,
    )


def _check_rate(times_s: Array, inside: Inside) -> None:
    gaps_s = np.diff(times_s)
    usual_s = float(np.median(gaps_s)) if gaps_s.size else 1.0
    if usual_s * _FASTEST_HZ < 1.0:
        said = f"{1.0 / usual_s:.0f} frames a second" if usual_s > 0.0 else "all frames at once"
        raise ImportFailure(
            f"{inside.path}: its times say {said}, as those of a copied data set do; say how many there were with "
            f"--rate, for example --rate 20"
        )


def _image(inside: Inside, name: str, tally: Tally) -> bytes:
    try:
        return as_jpeg(inside.read(name, MOST_BYTES))
    except ImportFailure as error:
        # The first one tells why.
        if not tally.counts[_UNREAD]:
            tally.say(str(error))
        raise NotAnImage(_UNREAD) from None
