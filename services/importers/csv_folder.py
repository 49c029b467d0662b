"""A folder of images with a CSV file of their times and the velocities of the robot.

The file is ``drive.csv``, or the only ``*.csv`` of the folder. Its first line names the columns:
``image`` (a file in the folder), ``time_s``, ``linear_m_s`` and ``angular_rad_s``
(counter-clockwise). Optional columns are ``episode``, ``success`` (1 or 0), and ``x_m``, ``y_m``
and ``heading_rad`` by odometry, with empty cells if unknown.
"""

import csv
from collections.abc import Iterator
from typing import Annotated, Final

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from services.importers.drive import MOST_SAMPLES, ImportedDrive, ImportFailure, Tally
from services.importers.images import Row, drive_of
from services.importers.inside import Inside
from services.importers.job import ImportJob

NAME: Final = "drive.csv"
POSE: Final = ("x_m", "y_m", "heading_rad")
COLUMNS: Final = ("episode", "image", "time_s", "linear_m_s", "angular_rad_s", "success", *POSE)


class _Line(BaseModel):
    """A line of the file; an empty cell is absent."""

    model_config = ConfigDict(str_strip_whitespace=True)
    episode: str = ""
    image: Annotated[str, Field(min_length=1)]
    time_s: FiniteFloat
    linear_m_s: FiniteFloat
    angular_rad_s: FiniteFloat
    success: bool | None = None
    x_m: FiniteFloat | None = None
    y_m: FiniteFloat | None = None
    heading_rad: FiniteFloat | None = None

    @property
    def pose(self) -> tuple[float, float, float] | None:
        """Pose by odometry."""
        if self.x_m is None or self.y_m is None or self.heading_rad is None:
            return None
        return self.x_m, self.y_m, self.heading_rad


def read(inside: Inside, job: ImportJob, tally: Tally) -> list[ImportedDrive]:
    """Read a folder; each episode is a drive."""
    names = [name for name in inside.names() if name.lower().endswith(".csv")]
    if NAME not in names and len(names) != 1:
        raise ImportFailure(
            f"{inside.path}: {NAME} not found, and {len(names)} CSV files to choose from"
        )
    name = NAME if NAME in names else names[0]
    drives: dict[str, list[Row]] = {}
    arrived: dict[str, bool] = {}
    for line in _lines(inside, name, job.rate_hz, tally):
        velocity = line.linear_m_s * (job.speed or 1.0), line.angular_rad_s * (job.turn_rate or 1.0)
        drives.setdefault(line.episode, []).append(
            Row(line.image, line.time_s, velocity, line.pose)
        )
        if line.success is not None:
            arrived[line.episode] = line.success
    if not drives:
        raise ImportFailure(f"{inside.called(name)}: no row has an image, a time and velocities")
    return [
        drive_of(inside, each, rows, tally, success=arrived.get(each))
        for each, rows in drives.items()
    ]


def _lines(inside: Inside, name: str, rate_hz: float | None, tally: Tally) -> Iterator[_Line]:
    table = csv.DictReader(_text(inside, name))
    try:
        needed = {"image", "linear_m_s", "angular_rad_s"} | (set() if rate_hz else {"time_s"})
        if lacks := sorted(needed - set(table.fieldnames or ())):
            raise ImportFailure(f"{inside.called(name)}: lacks the columns {', '.join(lacks)}")
        for number, values in enumerate(table):
            if number >= MOST_SAMPLES:
                raise ImportFailure(
                    f"{inside.called(name)}: too large (more than {MOST_SAMPLES} rows)"
                )
            told = {column: values[column] for column in COLUMNS if values.get(column)}
            try:
                yield _Line.model_validate(told | ({"time_s": number / rate_hz} if rate_hz else {}))
            except ValidationError:
                tally.count("rows lack an image or a number")
    except csv.Error as error:
        raise ImportFailure(f"{inside.called(name)}: not CSV: {error}") from None


def _text(inside: Inside, name: str) -> Iterator[str]:
    for number, line in enumerate(inside.lines(name), 1):
        try:
            yield line.decode("utf-8-sig" if number == 1 else "utf-8")
        except UnicodeDecodeError:
            raise ImportFailure(f"{inside.called(name)}: line {number} is not UTF-8") from None
