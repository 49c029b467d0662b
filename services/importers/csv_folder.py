"""A folder of images with a CSV file beside them that says when each was taken and how fast the robot went.

The file is ``drive.csv``, or the only ``*.csv`` of the folder. Its first line names the columns: ``image`` (a file in
the folder), ``time_s``, ``linear_m_s`` and ``angular_rad_s`` (counter-clockwise); where there are such, ``episode``,
``success`` (1 or 0), and ``x_m``, ``y_m`` and ``heading_rad`` by the wheels, which a row may leave empty.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from functools import partial
from typing import Final, NamedTuple

import numpy as np

from services.importers.drive import MOST_SAMPLES, Drive, Frame, ImportFailure, Motion, Source, Tally, Track
from services.importers.image_files import check_rate, image_file
from services.importers.inside import Inside
from services.importers.source_options import Wishes

NAME: Final = "drive.csv"
POSE: Final = ("x_m", "y_m", "heading_rad")
COLUMNS: Final = ("episode", "image", "time_s", "linear_m_s", "angular_rad_s", "success", *POSE)
_SUCCESS: Final = {"1": True, "true": True, "yes": True, "0": False, "false": False, "no": False}


class _Row(NamedTuple):
    time_s: float
    image: str
    velocity: tuple[float, float]
    pose: tuple[float, float, float] | None
    success: bool | None


def read(inside: Inside, wishes: Wishes, tally: Tally) -> Source:
    """Read such a folder; each episode is a drive."""
    name = _csv_name(inside)
    drives: dict[str, list[_Row]] = {}
    for episode, row in _rows(inside, name, wishes, tally):
        drives.setdefault(episode, []).append(row)
    if not drives:
        raise ImportFailure(f"{inside.called(name)}: no row has an image, a time and velocities")
    return Source([_drive(inside, *each, tally) for each in drives.items()], metric=True)


def _csv_name(inside: Inside) -> str:
    names = [name for name in inside.names() if name.lower().endswith(".csv")]
    if NAME in names:
        return NAME
    if len(names) != 1:
        raise ImportFailure(f"{inside.path}: needs {NAME} beside the images; there are {len(names)} CSV files")
    return names[0]


def _text(inside: Inside, name: str) -> Iterator[str]:
    for number, line in enumerate(inside.lines(name), 1):
        try:
            yield line.decode("utf-8-sig" if number == 1 else "utf-8")
        except UnicodeDecodeError:
            raise ImportFailure(f"{inside.called(name)}: line {number} is not UTF-8") from None


def _rows(inside: Inside, name: str, wishes: Wishes, tally: Tally) -> Iterator[tuple[str, _Row]]:
    table = csv.DictReader(_text(inside, name))
    try:
        columns = set(table.fieldnames or ())
        needed = {"image", "linear_m_s", "angular_rad_s"} | (set() if wishes.rate_hz else {"time_s"})
        if needed - columns:
            raise ImportFailure(f"{inside.called(name)}: lacks the columns {', '.join(sorted(needed - columns))}")
        for number, values in enumerate(table):
            if number >= MOST_SAMPLES:
                raise ImportFailure(f"{inside.called(name)}: more than {MOST_SAMPLES} rows")
            try:
                yield values.get("episode") or "", _row(values, number, wishes, posed=set(POSE) <= columns)
            except (ValueError, TypeError):
                tally.count("rows lack an image or a number")
    except csv.Error as error:
        raise ImportFailure(f"{inside.called(name)}: no CSV: {error}") from None


def _row(values: dict[str, str], number: int, wishes: Wishes, *, posed: bool) -> _Row:
    time_s = float(values["time_s"]) if wishes.rate_hz is None else number / wishes.rate_hz
    speed, turn_rate = wishes.speed or 1.0, wishes.turn_rate or 1.0
    velocity = speed * float(values["linear_m_s"]), turn_rate * float(values["angular_rad_s"])
    x, y, heading = (values[name] for name in POSE) if posed else ("", "", "")
    pose = (float(x), float(y), float(heading)) if x or y or heading else None
    if not np.isfinite((time_s, *velocity, *(pose or ()))).all() or not values["image"]:
        raise ValueError("no number")
    return _Row(time_s, values["image"], velocity, pose, _SUCCESS.get((values.get("success") or "").strip().lower()))


def _drive(inside: Inside, name: str, rows: list[_Row], tally: Tally) -> Drive:
    check_rate(np.array([row.time_s for row in rows]), inside)

    def frames() -> Iterator[Frame]:
        for row in rows:
            yield Frame(row.time_s, partial(image_file, inside, row.image, tally))

    return Drive(
        name,
        Motion.of([(row.time_s, *row.velocity) for row in rows], tally),
        frames,
        len(rows),
        Track.of([(row.time_s, *row.pose) for row in rows if row.pose is not None], tally),
        success=next((row.success for row in reversed(rows) if row.success is not None), None),
    )
