"""A folder of images with a ``drive.csv``, as ``smal import folder`` reads it; images are copied to the byte."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from pathlib import Path

from services.exporters.drives import Drive, say_view
from services.importers.csv_folder import COLUMNS, NAME
from services.importers.drive import Tally


def write(drives: Sequence[Drive], folder: Path, tally: Tally, advance: Callable[[], None]) -> None:
    """Write all drives into one folder, the images of each into a folder of its own."""
    say_view(drives, tally)
    with (folder / NAME).open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(COLUMNS)
        for drive in drives:
            (folder / drive.name).mkdir()
            for moment in drive.moments(tally):
                advance()
                if moment.jpeg is None:
                    continue
                if moment.velocity is None:
                    tally.count("frames do not tell what was done then, and are left out")
                    continue
                image = f"{drive.name}/{moment.tick:06d}.jpg"
                (folder / image).write_bytes(moment.jpeg)
                seconds, rest_ns = divmod(moment.stamp_ns, 1_000_000_000)
                pose = moment.pose
                way = ("", "", "") if pose is None else (pose.x_m, pose.y_m, pose.heading_rad)
                time_s = f"{seconds}.{rest_ns:09d}"
                table.writerow([drive.name, image, time_s, *moment.velocity, int(drive.success), *way])
