"""Figures of the report: each is a file of its own, and part of the page."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from matplotlib.figure import Figure

from services.experiments import html

_DPI: Final = 130


class EmbeddedFigures:
    """Writes each figure as a file, and embeds it with its caption.

    Parameters
    ----------
    folder
        Of the files; made if it does not exist.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        folder.mkdir(exist_ok=True)

    def __call__(self, name: str, figure: Figure, caption: str) -> str:
        """Write ``NAME.png``, and return the figure as HTML; the caption is HTML."""
        data = html.png(figure, _DPI)
        (self._folder / f"{name}.png").write_bytes(data)
        return f'<figure class="own">{html.image(data, name)}<figcaption>{caption}</figcaption></figure>'
