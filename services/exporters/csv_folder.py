"""A folder of images with a ``drive.csv``, as ``smal import folder`` reads it."""

import csv
from collections.abc import Callable, Sequence
from pathlib import Path

from services.exporters.drives import ExportedDrive, say_view
from services.importers.csv_folder import COLUMNS, NAME
from services.importers.drive import Tally


def write(
    drives: Sequence[ExportedDrive], folder: Path, tally: Tally, advance: Callable[[], None]
) -> None:
    """Write all drives into one folder, the images of each into its own subfolder."""
    say_view(drives, tally)
    with (folder / NAME).open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(COLUMNS)
        for drive in drives:
            (folder / drive.name).mkdir()
            for moment, jpeg, velocity in drive.usable(tally, advance):
                image = f"{drive.name}/{moment.tick:06d}.jpg"
                (folder / image).write_bytes(jpeg)
                seconds, rest_ns = divmod(moment.stamp_ns, 1_000_000_000)
                time_s = f"{seconds}.{rest_ns:09d}"
                way = moment.odometry.pose if moment.odometry else ("", "", "")
                table.writerow([drive.name, image, time_s, *velocity, int(drive.success), *way])
