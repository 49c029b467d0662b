"""What a robot is told of its base: topics, types, speeds. A file, which may begin with one of the presets."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from schemas.codec import describe, printable
from services.kit.bus import BusError, host_and_port
from services.kit.node import ServiceError
from services.robot.config import RobotSettings
from services.robot.loop import check_stopping
from services.ros2 import messages
from services.ros2.messages import Distribution
from services.ros2.wire import DialectName, qualified

PRESETS: Final = Path(__file__).parent / "presets"
#: A configuration is a page of text.
_LARGEST: Final = 65536
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Seconds = Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)]
Topic = Annotated[str, Field(pattern=r"^/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*$")]


class ConfigError(Exception):
    """A configuration cannot be used; the text says why in one line."""


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", use_attribute_docstrings=True)


class Camera(_Part):
    """Where pictures come from."""

    topic: Topic
    """Of the pictures."""
    type: Literal["sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image"] = messages.COMPRESSED_IMAGE
    """What comes there: JPEG, or pixels (rgb8, bgr8, mono8, yuv422)."""
    info: Topic | None = None
    """Of its calibration (CameraInfo), if it tells one."""
    latency_s: Seconds = 0.0
    """Seconds from the light on the sensor to the stamp of a picture."""


class Input(_Part):
    """A topic that is listened to."""

    topic: Topic
    """Its name; relative to the namespace unless it begins with a slash."""
    silence_s: Annotated[float, Field(gt=0, le=10, allow_inf_nan=False)] = 0.25
    """Seconds without a message after which the robot is not moved."""


class Scan(Input):
    """A laser scanner, or whatever tells distances as one."""

    silence_s: Annotated[float, Field(gt=0, le=10, allow_inf_nan=False)] = 0.5
    """Seconds without a message after which the robot is not moved; scanners turn 5 to 10 times a second."""
    stop_m: Positive
    """Nearer than this, from the scanner, nothing may be where the robot goes."""
    ahead_rad: Annotated[float, Field(gt=-3.15, lt=3.15)] = 0.0
    """Where ahead is in the scanner's own angles, counter-clockwise."""
    half_angle_rad: Annotated[float, Field(gt=0, lt=3.15)] = 0.6
    """How far to both sides of the way ahead, and back, is looked."""
    blind_m: Seconds = 0.0
    """Nearer than this are parts of the robot."""
    gap_rad: Annotated[float, Field(gt=0, lt=3.15)] = 0.2
    """The widest angle of a way of which the scanner may say nothing; at 0.3 m a table's leg, 6 cm, is as wide."""
    zero_is_free: bool = False
    """Whether a range of 0 says that nothing is within reach; a scanner that is covered or broken says the same."""
    behind: bool = True
    """Whether the way back must be seen to be free as well; false for a scanner that only looks ahead."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.blind_m >= self.stop_m:
            raise ValueError(
                f"scan: nothing would stop it, as blind_m is {self.blind_m:g} m and stop_m {self.stop_m:g} m"
            )
        return self


class Stop(_Part):
    """A topic that says when the robot must not go on: a bumper, a cliff, a button."""

    topic: Topic
    """Its name."""
    type: Literal[
        "irobot_create_msgs/msg/HazardDetectionVector", "turtlebot3_msgs/msg/SensorState", "std_msgs/msg/Bool"
    ]
    """What comes there; of a Bool, True means: do not move."""
    silence_s: Annotated[float, Field(gt=0, le=10, allow_inf_nan=False)] | None = 0.5
    """Seconds without a message after which the robot is not moved; null for a topic that speaks only of changes: it
    must have spoken once since its publisher, and we, were there."""


class Velocity(_Part):
    """How the base is told to move."""

    topic: Topic = "cmd_vel"
    """Of its commands."""
    type: Literal["auto", "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"] = "auto"
    """What it takes; auto: what it says that it subscribes to."""


class Ros2Config(_Part):
    """A base with a camera."""

    preset: str | None = None
    """The preset that this began with."""
    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,31}$")]
    """What the robot is called; recordings and models are of it."""
    router: str = "tcp/127.0.0.1:7447"
    """Address of the robot's Zenoh router (rmw_zenohd), or of its bridge."""
    dialect: DialectName = "rmw_zenoh"
    """How ROS 2 speaks over Zenoh there."""
    distribution: Distribution = "jazzy"
    """Its ROS 2 distribution."""
    domain: Annotated[int, Field(ge=0, le=232)] = 0
    """Its ROS_DOMAIN_ID."""
    namespace: Annotated[str, Field(pattern=r"^(/[A-Za-z_][A-Za-z0-9_]*)*$")] = ""
    """Namespace of its topics, for example /robot1."""
    speed_m_s: Positive
    """Speed of forward and backward."""
    turn_rate_rad_s: Positive
    """Rate of left and right."""
    braking_s: Seconds
    """From that speed to standing."""
    watchdog_s: Positive
    """Seconds without a command after which the base stands by itself; a base that has none must not be driven."""
    velocity: Velocity = Velocity()
    """How it is told to move."""
    camera: Camera
    """Its camera."""
    odometry: Input | None = None
    """Its wheels (Odometry); their silence is the base's."""
    imu: Input | None = None
    """Its inertial unit."""
    scan: Scan | None = None
    """Its scanner."""
    stops: tuple[Stop, ...] = ()
    """What else stops it."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        try:
            host_and_port(self.router)
        except BusError as error:
            raise ValueError(str(error)) from None
        return self

    def full(self, topic: str) -> str:
        """Return the full name of a topic."""
        return qualified(topic, self.namespace)


def known_presets() -> list[str]:
    """Return the names of the presets, sorted."""
    return sorted(path.stem for path in PRESETS.glob("*.yaml"))


def read_config(path: Path) -> Ros2Config:
    """Read a configuration.

    Parameters
    ----------
    path
        A YAML file; with `preset: NAME` it says only what differs from that one.

    Raises
    ------
    ConfigError
        It cannot be used.
    """
    own = _read(path)
    preset = own.get("preset")
    if preset is not None:
        if preset not in known_presets():
            raise ConfigError(f"{path}: preset: known are {', '.join(known_presets())}")
        own = _merged(_read(PRESETS / f"{preset}.yaml"), own)
    # YAML has lists, and a tuple is what does not change.
    if isinstance(own.get("stops"), list):
        own["stops"] = tuple(own["stops"])
    try:
        config = Ros2Config.model_validate(own)
        # Here, and not only where it drives: then nothing is started for a base that must not be driven.
        check_stopping(config)
    except ValidationError as error:
        raise ConfigError(f"{path}: {_explained(error)}") from None
    except ServiceError as error:
        raise ConfigError(f"{path}: {error}; services/ros2/README.md says what helps") from None
    return config


def _explained(error: ValidationError) -> str:
    errors = error.errors(include_url=False)
    missing = [one["loc"] for one in errors if one["type"] == "missing"]
    if ("watchdog_s",) in missing:
        return (
            "watchdog_s: say after how many seconds without a command the base stands by itself; one that does not "
            "must not be driven (services/ros2/README.md says how it can)"
        )
    if missing == [one["loc"] for one in errors] and len(missing) > 1:
        names = ", ".join(".".join(map(str, where)) for where in missing)
        return f"lacks {names}; a preset has what is usual: {', '.join(known_presets())}"
    first = errors[0]
    if first["type"] == "value_error":
        return str(first["ctx"]["error"])
    if first["type"] == "extra_forbidden" and len(first["loc"]) == 1:
        known = ", ".join(sorted(Ros2Config.model_fields))
        return f"{printable(str(first['loc'][0]))}: no such setting; known are {known}"
    return describe(error)


def _read(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            text = file.read(_LARGEST + 1)
        if len(text) > _LARGEST:
            raise ConfigError(f"{path}: larger than {_LARGEST} bytes; this is no configuration")
        tree = YAML(typ="safe", pure=True).load(text.decode())
    except OSError as error:
        raise ConfigError(
            f"{path}: {(error.strerror or str(error)).lower()}; presets: {', '.join(known_presets())}"
        ) from None
    except (YAMLError, ValueError, RecursionError) as error:
        reason = printable(" ".join(str(getattr(error, "problem", None) or error).split()))
        mark = getattr(error, "problem_mark", None)
        where = "" if mark is None else f" in line {mark.line + 1}"
        raise ConfigError(f"{path}: no YAML{where}: {reason}") from None
    if not isinstance(tree, dict):
        raise ConfigError(f"{path}: expected settings such as `preset: turtlebot4`")
    return tree


def _merged(base: dict[str, Any], own: dict[str, Any]) -> dict[str, Any]:
    both = dict(base)
    for key, value in own.items():
        was = both.get(key)
        both[key] = _merged(was, value) if isinstance(was, dict) and isinstance(value, dict) else value
    return both


class Ros2Settings(RobotSettings):
    """Which base."""

    ros2_config: Path
    """File that says which base this is, and how it is reached; it may begin with a preset."""
