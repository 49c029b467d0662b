"""What an import is asked for, and what came of it."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from typing import Annotated, Final, Literal, get_args

from pydantic import Field

from schemas.base import RobotId, Strict
from schemas.episode import GoalName
from services.importers.atoms import QUANTILE, STILL, TURNING
from services.importers.drive import LEAST_FOCAL, MOST_FOCAL
from services.kit.errors import UsageError

Format = Literal["rosbag2", "lerobot", "donkeycar", "folder"]
FORMATS: Final[tuple[Format, ...]] = get_args(Format)
#: What has to be installed for each.
_PACKAGES: Final[dict[Format, tuple[str, ...]]] = {"rosbag2": ("rosbags",), "lerobot": ("pyarrow", "av")}
_Fraction = Annotated[float, Field(gt=0.0, le=1.0)]
_Rate = Annotated[float, Field(gt=0.0, le=1000.0)]


class Job(Strict):
    """What is asked for."""

    format: Format
    """Which reader."""
    path: str
    """The source."""
    folder: str
    """Where to write."""
    robot: RobotId
    """Name of the robot."""
    goal: GoalName = "victim"
    """Where the drives lead."""
    success: bool | None = None
    """Whether they got there, whatever the source says; None to take its word, or else that they did."""
    reckon: bool = True
    """Whether to reckon a way from velocities."""
    from_s: Annotated[float, Field(ge=0.0, le=1e9)] = 0.0
    """Leave out what was before, of each drive."""
    to_s: Annotated[float, Field(gt=0.0, le=1e9)] = 1e9
    """Leave out what was after, of each drive."""
    focal: Annotated[float, Field(ge=LEAST_FOCAL, le=MOST_FOCAL)] | None = None
    """Focal length over the image's width, which goes before the source's own."""
    quantile: _Fraction = QUANTILE
    """Which of the moving samples is the nominal speed, see `services.importers.atoms`."""
    still: _Fraction = STILL
    """Fraction of it below which the robot stands."""
    turning: _Fraction = TURNING
    """Fraction of the nominal turn rate from which on it turns."""
    camera: str | None = None
    """Which camera, by the source's own name: a topic, or a feature."""
    velocity: str | None = None
    """Which velocities, by the source's own names."""
    rate_hz: _Rate | None = None
    """Frames a second, for a source whose times are wrong or missing."""
    speed: _Rate | None = None
    """Metres a second that the number 1 of the source stands for."""
    turn_rate: _Rate | None = None
    """Radians a second that the number 1 of the source stands for."""
    episodes: tuple[str, ...] = ()
    """Which drives, by the source's own names; all if empty."""


class Report(Strict):
    """What came of it."""

    files: tuple[str, ...]
    """Recordings."""
    ticks: int
    """In all of them."""
    successes: int
    """Drives that reached the goal."""
    odometry: Literal["of the source", "reckoned from velocities", "none"]
    """What teaches how far the robot went."""
    speed: float
    """Nominal speed, in the source's units."""
    turn_rate: float
    """Nominal turn rate, in the source's units."""
    metric: bool
    """Whether these units are metres and radians a second."""
    atoms: dict[str, int]
    """How many of each."""


def missing_packages(form: Format) -> list[str]:
    """Return what has to be installed for a format and is not."""
    return [name for name in _PACKAGES.get(form, ()) if importlib.util.find_spec(name) is None]


def check_format(name: str, formats: Sequence[Format] = FORMATS) -> Format:
    """Return the format of a name; what it needs is installed.

    Raises
    ------
    UsageError
        When there is none of that name, or something that it needs is missing.
    """
    form = next((one for one in formats if one == name), None)
    if form is None:
        raise UsageError(f"no format {name!r}; known are: {', '.join(formats)}")
    if missing := missing_packages(form):
        raise UsageError(f"{form} needs {' and '.join(missing)}: pip install -e '.[formats]'")
    return form
