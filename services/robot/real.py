"""Real bases: settings from a file, and views."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from schemas.base import Message
from schemas.codec import describe, printable
from services.kit.errors import UsageError
from services.kit.node import ServiceError
from services.robot.body import ImuReading, Kinematics, OdometryReading
from services.robot.loop import check_stopping
from services.robot.service import RobotSettings

_LARGEST: Final = 65536  # Maximum size; a configuration is a page of text.
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Seconds = Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)]
#: Silence after which the robot is not moved.
Silence = Annotated[float, Field(gt=0, le=10, allow_inf_nan=False)]


class ConfigPart(BaseModel):
    """A part of a configuration."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")


class BaseConfig(ConfigPart):
    """Settings of every real base."""

    preset: str | None = None
    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,31}$")]
    speed_m_s: Positive
    turn_rate_rad_s: Positive
    # Minimum turning radius of a car; 0 if it turns on the spot.
    radius_m: Annotated[float, Field(ge=0, le=100)] = 0.0
    braking_s: Seconds  # From nominal speed to standstill.
    #: Time without a command after which the base stops by itself; a base without a watchdog must
    #: not be driven.
    watchdog_s: Positive

    @property
    def kinematics(self) -> Kinematics:
        """Speeds and turning radius of the base."""
        return Kinematics(self.speed_m_s, self.turn_rate_rad_s, self.radius_m)


class BaseSettings(RobotSettings):
    """Settings of the service of a real base."""

    robot_config: Path
    """Configuration file of the base, which can begin with a preset."""


C = TypeVar("C", bound=BaseConfig)


#: Conditions that a person fulfils at a real robot.
BY_HAND: Final = frozenset({"start", "victim"})


@dataclass(frozen=True, eq=False)
class RealView:
    """Readings of a real base as `services.robot.body.View`."""

    jpeg: bytes
    captured_s: float
    contact: bool
    odometry: OdometryReading | None
    imu: tuple[ImuReading, ...] | None
    depth = None

    def more(self, _header: Message, _made: Collection[str] = ()) -> Iterator[Message]:
        """Yield nothing: the base has no other known sensors."""
        yield from ()


def known_presets(presets: Path) -> list[str]:
    """Return the names of the presets in a folder, sorted."""
    return sorted(path.stem for path in presets.glob("*.yaml"))


def read_config(path: Path, kind: type[C], presets: Path) -> C:
    """Read a configuration, merged into its `preset` if given; UsageError if it is invalid."""
    names = known_presets(presets)
    manual = f"services/{presets.parent.name}/README.md"
    own = _read(path, names)
    preset = own.get("preset")
    if preset is not None:
        if preset not in names:
            raise UsageError(f"{path}: preset not found; available: {', '.join(names)}")
        own = _merged(_read(presets / f"{preset}.yaml", names), own)
    try:
        config = kind.model_validate(own)
        # Checked here as well, so that no process starts for a base that must not be driven.
        check_stopping(config)
    except ValidationError as error:
        raise UsageError(f"{path}: {_explained(error, names, manual)}") from None
    except ServiceError as error:
        raise UsageError(f"{path}: {error}; for help see {manual}") from None
    return config


def _explained(error: ValidationError, names: list[str], manual: str) -> str:
    errors = error.errors(include_url=False)
    missing = [".".join(map(str, one["loc"])) for one in errors if one["type"] == "missing"]
    if "watchdog_s" in missing:
        return (
            "watchdog_s: required; give the seconds without a command after which the base stops "
            f"by itself (for a base without a watchdog see {manual})"
        )
    if len(missing) == len(errors) > 1:
        return f"missing {', '.join(missing)}; presets with defaults: {', '.join(names)}"
    if errors[0]["type"] == "value_error":  # A validator of ours, whose text names the setting.
        return str(errors[0]["ctx"]["error"])
    return describe(error)


def _read(path: Path, names: list[str]) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            text = file.read(_LARGEST + 1)
        if len(text) > _LARGEST:
            raise UsageError(f"{path}: too large for a configuration (maximum {_LARGEST} bytes)")
        tree = YAML(typ="safe", pure=True).load(text.decode())
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise UsageError(f"{path}: {reason}; presets: {', '.join(names)}") from None
    except (YAMLError, ValueError, RecursionError) as error:
        reason = printable(" ".join(str(getattr(error, "problem", None) or error).split()))
        mark = getattr(error, "problem_mark", None)
        where = "" if mark is None else f" in line {mark.line + 1}"
        raise UsageError(f"{path}: invalid YAML{where}: {reason}") from None
    if not isinstance(tree, dict):
        raise UsageError(f"{path}: expected settings such as `preset: {names[-1]}`")
    return tree


def _merged(base: dict[str, Any], own: dict[str, Any]) -> dict[str, Any]:
    both = dict(base)
    for key, value in own.items():
        was = both.get(key)
        both[key] = (
            _merged(was, value) if isinstance(was, dict) and isinstance(value, dict) else value
        )
    return both
