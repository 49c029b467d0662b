"""The page of what a model has learned: one HTML file that needs nothing beside it."""

from collections.abc import Iterator
from html import escape
from pathlib import Path
from typing import Final

import numpy as np

from schemas.codec import printable
from services.experiments import html
from services.experiments.showing.drives import TaughtDrives
from services.experiments.showing.map_page import map_page
from services.experiments.showing.summary import facts, taught_drives
from smal.model import Model
from smal.paper.model import Model as PaperModel
from smal.teaching.demonstration import Demonstration

_SHOWN: Final = 5  # Frames of a drive that are shown, spread over it.


def write_page(
    folder: Path,
    model: Model | PaperModel,
    file: Path,
    drives: TaughtDrives | None,
    advance: html.Advance = lambda _what, _done, _total: None,
) -> Path:
    """Write ``index.html`` of a model's file into a folder, with what recordings hold of it; return its path.

    ValueError names the episode of a damaged image.
    """
    found = {} if drives is None else drives.found
    body = [
        *_missing(drives),
        *(map_page(model, found, advance) if isinstance(model, Model) else ()),
        *_seen(model, found),
        "<h2>The model</h2>",
        html.table(["of", "is"], facts(model, str(file), file.stat().st_size).items(), left=2),
    ]
    return html.write_page(folder, f"SMAL: what {printable(file.name)} has learned", body)


def _missing(drives: TaughtDrives | None) -> Iterator[str]:
    if drives is None:
        yield (
            '<p class="note" role="note"><b>Without images.</b> A model keeps features of images, and no image; '
            "<code>--recordings DIR</code> names the recordings that it was taught from.</p>"
        )
    elif drives.missing:
        items = "".join(f"<li>{escape(line)}</li>" for line in drives.missing)
        count = f"{len(drives.missing)} of {len(drives.missing) + len(drives.found)} drives"
        yield f'<div class="note" role="note"><b>Missing:</b> {count}.<ul>{items}</ul></div>'


def _seen(model: Model | PaperModel, found: dict[int, Demonstration]) -> Iterator[str]:
    """Show each drive that is there in some frames; name all."""
    taught = taught_drives(model)
    names = [printable(", ".join(one.parts)) for one in taught]
    yield "<h2>The drives</h2>"
    for number, one in found.items():
        assert one.images is not None  # noqa: S101 - those that are found have them
        frames = np.unique(np.linspace(0, len(one.atoms) - 1, _SHOWN).astype(int)).tolist()
        yield html.strip({f"{names[number]}, frame {frame}": one.images[frame] for frame in frames})
    rows = [
        [names[number], printable(one.end), "there" if number in found else "not there", f"{one.frames:,}"]
        for number, one in enumerate(taught)
    ]
    yield html.table(["name", "leads", "recording", "frames"], rows, left=3)
