"""Configuration of a base without ROS, from a file that can extend a preset."""

from functools import cache
from itertools import chain
from pathlib import Path
from typing import Annotated, Final, Literal, Self
from urllib.parse import urlsplit

from pydantic import Field, Strict, model_validator

from schemas.base import STANDING, Velocity
from services.robot import real
from services.robot.real import BaseConfig, ConfigPart, Positive, Seconds, Silence
from services.serial.template import Template

PRESETS: Final = Path(__file__).parent / "presets"
#: Numbers of a command: of the base, of its wheels, as shares (-1 to 1), and the watchdog.
COMMAND: Final = (
    *("linear_m_s", "angular_rad_s", "left_m_s", "right_m_s"),
    *("linear", "angular", "left", "right", "steering"),
    "watchdog_s",
)
_OF_WHEELS: Final = frozenset({"left_m_s", "right_m_s", "left", "right", "left_m", "right_m"})
#: Numbers of an odometry line: one of these sets.
ODOMETRY: Final = (
    ("x_m", "y_m", "heading_rad"),
    ("left_m", "right_m"),
    ("left_m_s", "right_m_s"),
    ("linear_m_s", "angular_rad_s"),
)
#: Velocities whose lines must differ: standing, ahead, and a bend.
_DIFFERENT: Final = (STANDING, Velocity(1.0, 0.0), Velocity(1.0, 0.5))


class CameraConfig(ConfigPart):
    """A camera that OpenCV opens."""

    #: Index of a camera, device (/dev/video0), address (rtsp://, http:// of MJPEG), or video file.
    source: int | str
    width: Annotated[int, Field(ge=64, le=4096)] = 640  # Wider images are reduced.
    rotate: Literal[0, 90, 180, 270] = 0  # Clockwise turn that puts the image upright, degrees.
    latency_s: Seconds = 0.05  # From the exposure to the arrival of an image.
    #: Horizontal field of view of a lens without distortion, degrees.
    field_deg: Annotated[float | None, Field(ge=5, le=170)] = None


class Lines(ConfigPart):
    """Address of the base, and its line of a velocity."""

    address: str  # A serial port (/dev/ttyUSB0), tcp://HOST:PORT or udp://HOST:PORT.
    baud: Annotated[int, Field(ge=1200, le=4_000_000)] = 115200
    opening: Annotated[tuple[str, ...], Strict(False)] = ()  # Lines that are sent after the start.
    settle_s: Seconds = 0.0  # Time after the opening of the port in which the base starts.
    velocity: str
    end: Annotated[str, Field(min_length=1, max_length=4)] = "\n"
    track_m: Positive | None = None  # Distance of the left and right wheels.
    #: Speed of a wheel at a share of 1; the speed of the base by default.
    wheel_m_s: Positive | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not _is_address(self.address):
            raise ValueError(
                f"base.address: {self.address!r} must be a serial port such as /dev/ttyUSB0, "
                "tcp://HOST:PORT or udp://HOST:PORT"
            )
        return self


class OdometryLine(ConfigPart):
    """A line with which the base reports its odometry."""

    line: str
    silence_s: Silence = 0.5

    @model_validator(mode="after")
    def _check(self) -> Self:
        found = set(self.template().names)
        if not any(found == set(names) for names in ODOMETRY):
            sets = "; ".join(" ".join(f"{{{name}}}" for name in names) for names in ODOMETRY)
            raise ValueError(f"odometry.line: must have the numbers of one of: {sets}")
        return self

    def template(self) -> Template:
        """Return the template of the line."""
        return _template("odometry.line", self.line, tuple(chain(*ODOMETRY)))


class SerialConfig(BaseConfig):
    """A base without ROS; for the settings see services/serial/README.md."""

    camera: CameraConfig
    base: Lines
    odometry: OdometryLine | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        used = self._used()
        if "steering" in used and not self.radius_m:
            raise ValueError("radius_m: required for {steering} (minimum turning radius, metres)")
        if used & _OF_WHEELS and self.base.track_m is None:
            raise ValueError("base.track_m: required for wheels (distance left to right, metres)")
        if len({self.command(velocity) for velocity in _DIFFERENT}) < len(_DIFFERENT):
            raise ValueError(
                f"base.velocity: {self.base.velocity!r} must differ for standing, driving ahead "
                f"and driving a bend; numbers: {', '.join(COMMAND)}"
            )
        return self

    def _used(self) -> set[str]:
        """Return the numbers of all lines."""
        lines = [_template("base.opening", line, COMMAND) for line in self.base.opening]
        lines.append(_template("base.velocity", self.base.velocity, COMMAND))
        if self.odometry is not None:
            lines.append(self.odometry.template())
        return {name for line in lines for name in line.names}

    def command(self, velocity: Velocity) -> str:
        """Return the text that makes the base drive at a velocity."""
        template = _template("base.velocity", self.base.velocity, COMMAND)
        return template.write(self._values(velocity)) + self.base.end

    def opening(self) -> str:
        """Return the text that is sent after the start of the base."""
        values = self._values(STANDING)
        lines = [_template("base.opening", line, COMMAND) for line in self.base.opening]
        return "".join(line.write(values) + self.base.end for line in lines)

    def _values(self, velocity: Velocity) -> dict[str, float]:
        ahead_m_s = velocity.linear * self.speed_m_s
        turn_rad_s = velocity.angular * self.turn_rate_rad_s
        difference_m_s = turn_rad_s * (self.base.track_m or 0.0) / 2
        left_m_s = ahead_m_s - difference_m_s
        right_m_s = ahead_m_s + difference_m_s
        # Wheels at their limit keep the curve, and drive it more slowly.
        full_m_s = max(self.base.wheel_m_s or self.speed_m_s, abs(left_m_s), abs(right_m_s))
        bend = turn_rad_s * self.radius_m / ahead_m_s if ahead_m_s else 0.0
        return {
            "linear_m_s": ahead_m_s,
            "angular_rad_s": turn_rad_s,
            "linear": velocity.linear,
            "angular": velocity.angular,
            "steering": min(max(bend, -1.0), 1.0),
            "left_m_s": left_m_s,
            "right_m_s": right_m_s,
            "left": left_m_s / full_m_s,
            "right": right_m_s / full_m_s,
            "watchdog_s": self.watchdog_s,
        }


def _is_address(text: str) -> bool:
    try:
        where = urlsplit(text)
        network = where.scheme in ("tcp", "udp") and bool(where.hostname) and bool(where.port)
    except ValueError:  # A port that is no number, or too large.
        return False
    return network or text.startswith("/")


@cache
def _template(where: str, text: str, known: tuple[str, ...]) -> Template:
    try:
        return Template(text, known)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def read_config(path: Path) -> SerialConfig:
    """Read the configuration of a base; UsageError if it is invalid."""
    return real.read_config(path, SerialConfig, PRESETS)
