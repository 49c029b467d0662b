"""Folders of images, or of a video, with a table of the robot's velocities or poses.

The table is ``drive.csv``, or the only ``*.csv`` of the folder, as spreadsheets write it: with
commas, semicolons or tabs, points or commas in numbers. Its first line names the columns: ``image``
(a file in the folder), ``time_s``, ``linear_m_s`` and ``angular_rad_s`` (counter-clockwise).
Optional columns are ``episode``, ``success`` (1 or 0), and ``x_m``, ``y_m`` and ``heading_rad`` by
odometry, with empty cells if unknown. Without velocities, these poses give them.

Without the column ``image`` the folder has one video. The times count from its first frame; if the
first is later than its end, the video begins at the first row.
"""

import csv
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import chain
from typing import Annotated, Any, Final

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from schemas.codec import describe, printable
from services.importers import layouts
from services.importers.clocks import seconds_of
from services.importers.drive import MOST_SAMPLES, POSE, ImportedDrive, ImportFailure, Reads, Tally
from services.importers.images import Row, drive_of
from services.importers.inside import Inside
from services.importers.job import ImportJob
from services.importers.videos import SUFFIXES, Film

NAME: Final = "drive.csv"
VELOCITY: Final = ("linear_m_s", "angular_rad_s")
COLUMNS: Final = ("episode", "image", "time_s", *VELOCITY, "success", *POSE)
_TEXTS: Final = ("episode", "image")
_BEYOND: Final = ""  # Key of the cells of a row that have no column.


class _Line(BaseModel):
    """A line of the table; an empty cell is absent."""

    model_config = ConfigDict(str_strip_whitespace=True)
    episode: str = ""
    image: Annotated[str, Field(min_length=1)] | None = None
    time_s: FiniteFloat
    linear_m_s: FiniteFloat | None = None
    angular_rad_s: FiniteFloat | None = None
    success: bool | None = None
    x_m: FiniteFloat | None = None
    y_m: FiniteFloat | None = None
    heading_rad: FiniteFloat | None = None

    def row(self, job: ImportJob) -> Row:
        """Return the frame of this line, its velocity in metres and radians per second."""
        velocity = pose = None
        if self.linear_m_s is not None and self.angular_rad_s is not None:
            speed, turn_rate = job.scale()
            velocity = self.linear_m_s * speed, self.angular_rad_s * turn_rate
        if self.x_m is not None and self.y_m is not None and self.heading_rad is not None:
            pose = self.x_m, self.y_m, self.heading_rad
        return Row(self.image or "", self.time_s, velocity, pose)


def found(inside: Inside) -> bool:
    """Return whether a folder has a table, or the layout of a data set."""
    return bool(_tables(inside)) or layouts.found(inside)


def read(inside: Inside, job: ImportJob, tally: Tally) -> Reads:
    """Return the reads of the drives of a folder, by episode."""
    names = _tables(inside)
    if not names and layouts.found(inside):
        return layouts.read(inside, job, tally)
    if NAME not in names and len(names) != 1:
        raise ImportFailure(
            f"{inside.path}: {NAME} not found, and {len(names)} CSV files to choose from"
        )
    return _reads(inside, NAME if NAME in names else names[0], job, tally)


def _reads(inside: Inside, name: str, job: ImportJob, tally: Tally) -> Reads:
    job.check_used("a table", "rate_hz", "speed", "turn_rate")
    films = [each for each in inside.names() if each.lower().endswith(SUFFIXES)]
    episodes: dict[str, list[Row]] = {}
    arrived: dict[str, bool] = {}
    for number, line in enumerate(_lines(inside, name, job.rate_hz, films, tally)):
        episodes.setdefault(line.episode, []).append(line.row(job)._replace(number=number))
        if line.success is not None:
            arrived[line.episode] = line.success
    every = [row for rows in episodes.values() for row in rows]
    times_s = iter(seconds_of(np.array([row.time_s for row in every]), tally).tolist())
    episodes = {
        name: [row._replace(time_s=next(times_s)) for row in rows]
        for name, rows in episodes.items()
    }
    if not every:
        raise ImportFailure(f"{inside.called(name)}: no row has an image, a time and velocities")
    shown = None if every[0].image else Film(inside, films[0], list(episodes.values()), tally).part

    def drives(episode: str) -> list[ImportedDrive]:
        fields: dict[str, Any] = {"success": arrived.get(episode), "turn_rate": job.scale()[1]}
        return [drive_of(inside, episode, episodes[episode], tally, shown=shown, **fields)]

    return {episode: partial(drives, episode) for episode in episodes}


def _tables(inside: Inside) -> list[str]:
    return [name for name in inside.names() if name.lower().endswith(".csv")]


def _lines(
    inside: Inside, name: str, rate_hz: float | None, films: Sequence[str], tally: Tally
) -> Iterator[_Line]:
    called = inside.called(name)
    try:
        table = _table(inside, name)
        given = [column.strip().lower() for column in table.fieldnames or ()]
        table.fieldnames = given
        needed = _needed(given, called, films, rate_hz)
        for number, values in enumerate(table):
            if number >= MOST_SAMPLES:
                raise ImportFailure(f"{called}: too large (more than {MOST_SAMPLES} rows)")
            try:
                yield _line(values, needed, None if rate_hz is None else number / rate_hz)
            except ValueError as error:
                tally.say_first("row", f"{called}: row {number + 1}: {describe(error)}")
                tally.count("rows lack an image or a number")
    except csv.Error as error:
        raise ImportFailure(f"{called}: not CSV: {error}") from None


def _line(values: dict[str, str], needed: set[str], time_s: float | None) -> _Line:
    """Parse a row of the table; ValueError if it is incomplete."""
    if any(values.get(_BEYOND, ())):
        raise ValueError("more cells than columns; if numbers have commas, separate by semicolons")
    filled = {column: values[column] for column in COLUMNS if values.get(column)}
    # A spreadsheet in Europe writes 0,5 for 0.5.
    filled |= {key: filled[key].replace(",", ".") for key in filled if key not in _TEXTS}
    filled |= {} if time_s is None else {"time_s": str(time_s)}
    if lacks := sorted(needed - filled.keys()):
        raise ValueError(f"no {', '.join(lacks)}")
    return _Line.model_validate(filled)


def _needed(
    given: Sequence[str], called: str, films: Sequence[str], rate_hz: float | None
) -> set[str]:
    """Return the columns that each row needs; raise ImportFailure if the table lacks them."""
    needed = set(POSE if set(POSE) <= set(given) and not set(VELOCITY) & set(given) else VELOCITY)
    if rate_hz is None:
        needed.add("time_s")
    if "image" in given or len(films) != 1:
        needed.add("image")
    if lacks := sorted(needed - set(given)):
        named = printable(", ".join(filter(None, given)))[:200] or "none"
        raise ImportFailure(
            f"{called}: lacks the columns {', '.join(lacks)}; it has {named}, beside "
            f"{len(films)} videos"
        )
    return needed


def _table(inside: Inside, name: str) -> "csv.DictReader[str]":
    """Return the table of a file, whose first line shows the delimiter."""
    text = _text(inside, name)
    header = next(text, "")
    if header.lower().startswith("sep="):  # A line that Excel adds.
        header = next(text, "")
    delimiter = max(",;\t", key=header.count)
    return csv.DictReader(chain([header], text), restkey=_BEYOND, delimiter=delimiter)


def _text(inside: Inside, name: str) -> Iterator[str]:
    for number, line in enumerate(inside.lines(name), 1):
        if b"\0" in line:
            raise ImportFailure(
                f"{inside.called(name)}: line {number} is not text; save it as CSV UTF-8"
            )
        try:
            yield line.decode("utf-8-sig" if number == 1 else "utf-8")
        except UnicodeDecodeError:
            yield line.decode("cp1252", errors="replace")  # Text of Windows.
