"""What the pages of both schemes have in common: figures, strips of images, what is missing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from html import escape
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from services.experiments.drawing import svg
from services.experiments.showing.drives import TaughtDrives
from services.kit.jpeg import encode_jpeg, shrunk

#: How wide a frame is shown, pixels: a strip of five is as wide as a telephone, twice.
_FRAME_PX: Final = 160
_GAP_PX: Final = 4
#: Of many states, so many are named.
_NAMED: Final = 10


def missing(found: TaughtDrives | None, drives: int) -> Iterator[str]:
    """Say which recordings of how many drives are not there."""
    if found is None:
        yield (
            '<p class="note" role="note"><b>Without images.</b> A model keeps features of images, and no image; '
            "<code>--recordings DIR</code> names the recordings that it was taught from.</p>"
        )
    elif found.missing:
        items = "".join(f"<li>{escape(line)}</li>" for line in found.missing)
        count = f"{len(found.missing)} of {drives} drives"
        yield f'<div class="note" role="note"><b>Missing:</b> {count}.<ul>{items}</ul></div>'


def strip(file: Path, images: Sequence[NDArray[np.uint8]], said: str) -> str:
    """Write frames as one picture, and show it when it is looked at."""
    views = [shrunk(image, _FRAME_PX) for image in images]
    gap = np.full((len(views[0]), _GAP_PX, 3), 128, np.uint8)
    whole: NDArray[np.uint8] = np.concatenate([part for view in views for part in (gap, view)][1:], axis=1)
    file.parent.mkdir(exist_ok=True)
    file.write_bytes(encode_jpeg(whole))
    height, width = whole.shape[:2]
    where = f"{file.parent.name}/{file.name}"
    return f'<img loading="lazy" src="{where}" width="{width}" height="{height}" alt="{said}">'


def figure(drawn: Figure, name: str, title: str, said: str) -> str:
    """Return a figure with its caption, which is HTML; the title is text."""
    return (
        f'<figure class="own"><h3>{escape(title)}</h3>{svg(drawn, name, title)}<figcaption>{said}</figcaption></figure>'
    )


def counted(count: int, what: str) -> str:
    """Say how many there are."""
    return f"{count} {what}{'s' * (count != 1)}"


def seconds(seconds: float) -> str:
    """Say a time to a goal."""
    return f"{seconds:.1f} s" if np.isfinite(seconds) else "no way"


def listed(states: Sequence[int]) -> str:
    """Name some states."""
    if not states:
        return ""
    more = f" and {len(states) - _NAMED} more" if len(states) > _NAMED else ""
    return f" ({', '.join(map(str, states[:_NAMED]))}{more})"
