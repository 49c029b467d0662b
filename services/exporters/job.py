"""The formats, and one export into one of them."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from services.exporters.drives import Drive
from services.importers.drive import Tally
from services.importers.job import Format

#: Where each is written.
_WRITERS: Final[dict[Format, str]] = {
    "rosbag2": "services.exporters.rosbag2",
    "lerobot": "services.exporters.lerobot",
    "folder": "services.exporters.csv_folder",
}
FORMATS: Final = tuple(_WRITERS)


def write(
    form: Format, drives: Sequence[Drive], folder: Path, tally: Tally, advance: Callable[[], None] = lambda: None
) -> None:
    """Write drives into a folder that is empty; ``advance`` is called for each of their ticks.

    Raises
    ------
    ExportFailure
        When the format has no room for them.
    OSError
        When it cannot be written.
    """
    importlib.import_module(_WRITERS[form]).write(drives, folder, tally, advance)
