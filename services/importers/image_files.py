"""Image files in a folder, and times that they can have."""

from __future__ import annotations

from typing import Final

import numpy as np

from services.importers.drive import Array, ImportFailure, NotAnImage, Tally
from services.importers.images import MOST_BYTES, as_jpeg
from services.importers.inside import Inside, Missing, Outside

#: No camera of a robot is faster; then the times are those of copying the data set.
_FASTEST_HZ: Final = 120.0


def check_rate(times_s: Array, inside: Inside) -> None:
    """Refuse times that no camera's frames have, whose ticks would show nothing of how the robot drove."""
    gaps_s = np.diff(times_s)
    usual_s = float(np.median(gaps_s)) if gaps_s.size else 1.0
    if usual_s * _FASTEST_HZ < 1.0:
        said = f"{1.0 / usual_s:.0f} frames a second" if usual_s > 0.0 else "all frames at once"
        raise ImportFailure(
            f"{inside.path}: its times say {said}, as those of a copied data set do; say how many there were with "
            f"--rate, for example --rate 20"
        )


def image_file(inside: Inside, name: str, tally: Tally) -> bytes:
    """Return an image file of a folder as JPEG.

    Raises
    ------
    NotAnImage
        When it is none, or is not there, or is outside.
    """
    try:
        return as_jpeg(inside.read(name, MOST_BYTES))
    except Missing:
        raise NotAnImage("images are missing") from None
    except Outside as error:
        tally.say(str(error))
        raise NotAnImage("images are outside of the folder") from None
    except ImportFailure:
        raise NotAnImage("images cannot be read, or are larger than 16 MiB") from None
