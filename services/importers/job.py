"""Options and result of an import."""

import importlib.util
from collections.abc import Sequence
from typing import Annotated, Final, Literal, get_args

from pydantic import AfterValidator, Field

from schemas.base import STILL, TURNING, RobotId, Strict
from schemas.codec import printable
from schemas.episode import GoalName
from services.importers.drive import ImportFailure
from services.importers.ticks import QUANTILE
from services.kit.errors import UsageError

Format = Literal["rosbag2", "rosbag1", "lerobot", "donkeycar", "folder"]
FORMATS: Final[tuple[Format, ...]] = get_args(Format)
Rotation = Literal[0, 90, 180, 270]
ROTATIONS_DEG: Final[tuple[Rotation, ...]] = get_args(Rotation)
#: Packages that a format needs.
_PACKAGES: Final[dict[Format, tuple[str, ...]]] = {
    "rosbag2": ("rosbags",),
    "rosbag1": ("rosbags",),
    "lerobot": ("pyarrow", "av"),
}
#: Options that some kinds of sources use.
_OPTIONS: Final = {
    "camera": "--camera",
    "velocity": "--velocity",
    "odometry": "--odometry",
    "rate_hz": "--rate",
    "speed": "--speed",
    "turn_rate": "--turn-rate",
}
_Fraction = Annotated[float, Field(gt=0.0, le=1.0)]
_Rate = Annotated[float, Field(gt=0.0, le=1000.0)]


def _not_zero(value: float) -> float:
    if value == 0.0:
        raise ValueError(
            "0 is invalid: it removes every turn; omit it, or give the radians per second of value 1"
        )
    return value


_TurnRate = Annotated[float, Field(ge=-1000.0, le=1000.0), AfterValidator(_not_zero)]


class ImportJob(Strict):
    """Options of an import (see `smal import --help`), under the names of the source."""

    format: Format
    path: str
    folder: str
    robot: RobotId
    goal: GoalName = "victim"
    success: bool | None = None
    reckon: bool = True
    from_s: Annotated[float, Field(ge=0.0, le=1e9)] = 0.0
    to_s: Annotated[float, Field(gt=0.0, le=1e9)] = 1e9
    field_of_view_deg: Annotated[float, Field(ge=5.0, le=220.0)] | None = None
    quantile: _Fraction = QUANTILE
    still: _Fraction = STILL
    turning: _Fraction = TURNING
    camera: str | None = None
    rotate_deg: Rotation = 0  # Clockwise.
    velocity: str | None = None
    odometry: str | None = None
    rate_hz: _Rate | None = None
    speed: _Rate | None = None
    turn_rate: _TurnRate | None = None  # Below 0: mirrored.
    episodes: tuple[str, ...] = ()

    def scale(self, turn_rate: float = 1.0) -> tuple[float, float]:
        """Return speed and turn rate of value 1, by default 1 m/s and a turn rate of the source."""
        return (
            1.0 if self.speed is None else self.speed,
            turn_rate if self.turn_rate is None else self.turn_rate,
        )

    def check_used(self, source: str, *used: str) -> None:
        """Raise ImportFailure if an option is set that has no effect on a kind of source."""
        for name, option in _OPTIONS.items():
            if name not in used and getattr(self, name) is not None:
                raise ImportFailure(f"{option} has no effect on {source}; omit it")


OdometryOrigin = Literal["of the source", "computed from velocities", "none"]


class ImportReport(Strict):
    """Result of an import: recordings, ticks, actions, successful drives, nominal velocities."""

    files: tuple[str, ...]
    ticks: int
    successes: int
    odometry: OdometryOrigin
    speed: float
    turn_rate: float
    metric: bool  # Whether these are metres and radians per second; otherwise units of the source.
    atoms: dict[str, int]
    field_of_view_deg: float | None = None  # None without a calibrated camera.


def choose(
    what: str, wish: str | None, usual: Sequence[str], known: Sequence[str], how: str
) -> str:
    """Return the requested name, or else the only usual name; ImportFailure otherwise."""
    names = [wish] if wish else usual
    if len(names) == 1 and names[0] in known:
        return names[0]
    wrong = f"{wish} not found" if wish else f"{len(usual)} found"
    named = printable(", ".join(known), 300) or "none"
    raise ImportFailure(f"{what}: {wrong}; choose from {named} with {how}")


def missing_packages(form: Format) -> list[str]:
    """Return the missing packages of a format."""
    return [name for name in _PACKAGES.get(form, ()) if importlib.util.find_spec(name) is None]


def check_format(name: str, formats: Sequence[Format] = FORMATS) -> Format:
    """Return the format of a name; raise UsageError if it is unknown or a package is missing."""
    form = next((one for one in formats if one == name), None)
    if form is None:
        raise UsageError(f"format {name!r} not found; choose from {', '.join(formats)}")
    if missing := missing_packages(form):
        raise UsageError(f"{form} needs {' and '.join(missing)}: pip install -e '.[formats]'")
    return form
