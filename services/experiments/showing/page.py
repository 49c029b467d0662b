"""The page of what a model has learned: one HTML file, with images in a folder beside it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from schemas.codec import printable
from services.experiments import html
from services.experiments.showing.drives import TaughtDrives
from services.experiments.showing.map_page import MapPage
from services.experiments.showing.paper_page import PaperPage
from smal.model import Model
from smal.paper.model import Model as PaperModel


def write_page(
    folder: Path,
    model: Model | PaperModel,
    file: Path,
    found: TaughtDrives | None,
    advance: Callable[[str, int, int], None] = lambda _what, _done, _total: None,
) -> Path:
    """Write ``index.html`` and its images into a folder.

    Parameters
    ----------
    folder
        Is there already.
    model, file
        And where it is.
    found
        What recordings hold of its drives; None where none are given.
    advance
        Called with what is being done, how much of it is and how much there is.

    Returns
    -------
    Path
        Of the page.

    Raises
    ------
    ValueError
        An image of a recording is damaged; the text names its episode.
    """
    path = folder / "index.html"
    page = (
        MapPage(folder, model, file, found, advance)
        if isinstance(model, Model)
        else PaperPage(folder, model, file, found, advance)
    )
    title = f"SMAL: what {printable(file.name)} has learned"
    path.write_text(html.page(title, "\n".join(page.body()), 72), encoding="utf-8")
    return path
