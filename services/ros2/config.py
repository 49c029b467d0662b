"""What a robot is told of its base: topics, types, speeds. A file, which may begin with one of the presets."""

from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from schemas.codec import describe, printable
from services.kit.bus import BusError, host_and_port
from services.kit.errors import UsageError
from services.kit.node import ServiceError
from services.robot.loop import check_stopping
from services.robot.service import RobotSettings
from services.ros2 import messages
from services.ros2.messages import Distribution
from services.ros2.wire import DialectName, qualified

PRESETS: Final = Path(__file__).parent / "presets"
_LARGEST: Final = 65536  # A configuration is a page of text.
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Seconds = Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)]
#: Without a message for so long the robot is not moved.
Silence = Annotated[float, Field(gt=0, le=10, allow_inf_nan=False)]
Angle = Annotated[float, Field(gt=0, lt=3.15)]
#: A name; relative to the namespace unless it begins with a slash.
Topic = Annotated[str, Field(pattern=r"^/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*$")]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")


class CameraTopics(_Part):
    """Where pictures come from: JPEG, or pixels (rgb8, bgr8, mono8, yuv422); and where the calibration does."""

    topic: Topic
    type: Literal["sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image"] = (
        messages.COMPRESSED_IMAGE
    )
    info: Topic | None = None
    latency_s: Seconds = 0.0  # From the light on the sensor to the stamp of a picture.


class Input(_Part):
    """A topic that is listened to."""

    topic: Topic
    silence_s: Silence = 0.25


class ScanTopic(Input):
    """A laser scanner, or whatever tells distances as one; scanners turn 5 to 10 times a second."""

    silence_s: Silence = 0.5
    stop_m: Positive  # Nearer than this, from the scanner, nothing may be where the robot goes.
    #: Where ahead is in the scanner's own angles, counter-clockwise; and how far to both sides of the way is looked.
    ahead_rad: Annotated[float, Field(gt=-3.15, lt=3.15)] = 0.0
    half_angle_rad: Angle = 0.6
    blind_m: Seconds = 0.0  # Nearer than this are parts of the robot.
    #: The widest angle of a way of which the scanner may say nothing; at 0.3 m a table's leg, 6 cm, is as wide.
    gap_rad: Angle = 0.2
    #: Whether a range of 0 says that nothing is within reach; a scanner that is covered or broken says the same.
    zero_is_free: bool = False
    #: Whether the way back must be seen to be free as well; false for a scanner that only looks ahead.
    behind: bool = True

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.blind_m >= self.stop_m:
            raise ValueError(
                f"scan: nothing would stop it, as blind_m is {self.blind_m:g} m and stop_m {self.stop_m:g} m"
            )
        return self


class StopTopic(_Part):
    """A topic that says when the robot must not go on: a bumper, a cliff, a button; of a Bool, True means that."""

    topic: Topic
    type: Literal[
        "irobot_create_msgs/msg/HazardDetectionVector",
        "turtlebot3_msgs/msg/SensorState",
        "std_msgs/msg/Bool",
    ]
    #: None for one that speaks only of changes: it must have spoken once since its publisher, and we, were there.
    silence_s: Silence | None = 0.5


class VelocityTopic(_Part):
    """How the base is told to move; auto is what it says that it subscribes to."""

    topic: Topic = "cmd_vel"
    type: Literal[
        "auto", "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped",
        "ackermann_msgs/msg/AckermannDrive", "ackermann_msgs/msg/AckermannDriveStamped",
    ] = "auto"  # fmt: skip
    wheelbase_m: Annotated[float | None, Field(gt=0, le=10)] = (
        None  # From axle to axle, of what takes AckermannDrive.
    )


class Ros2Config(_Part):
    """A base with a camera; services/ros2/README.md says what each setting is."""

    preset: str | None = None
    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,31}$")]
    router: str = "tcp/127.0.0.1:7447"
    dialect: DialectName = "rmw_zenoh"
    distribution: Distribution = "jazzy"
    domain: Annotated[int, Field(ge=0, le=232)] = 0
    namespace: Annotated[str, Field(pattern=r"^(/[A-Za-z_][A-Za-z0-9_]*)*$")] = ""
    speed_m_s: Positive
    turn_rate_rad_s: Positive
    radius_m: Annotated[float, Field(ge=0, le=100)] = (
        0.0  # Least radius of its way, of a car; 0: it turns on the spot.
    )
    braking_s: Seconds  # From that speed to standing.
    #: Without a command for so long the base stands by itself; a base that has no watchdog must not be driven.
    watchdog_s: Positive
    velocity: VelocityTopic = VelocityTopic()
    camera: CameraTopics
    odometry: Input | None = None  # The wheels; their silence is the base's.
    imu: Input | None = None
    scan: ScanTopic | None = None
    stops: tuple[StopTopic, ...] = ()

    @model_validator(mode="after")
    def _check(self) -> Self:
        try:
            host_and_port(self.router)
        except BusError as error:
            raise ValueError(str(error)) from None
        told = self.velocity.type
        car = self.velocity.wheelbase_m is not None
        if told != "auto" and ("Ackermann" in told) != car:
            raise ValueError("velocity: wheelbase_m belongs to an AckermannDrive, which needs it")
        if car and self.radius_m == 0.0:
            raise ValueError(
                "radius_m: what takes AckermannDrive has a least radius of its way; say it"
            )
        return self

    def full(self, topic: str) -> str:
        """Return the full name of a topic."""
        return qualified(topic, self.namespace)


def known_presets() -> list[str]:
    """Return the names of the presets, sorted."""
    return sorted(path.stem for path in PRESETS.glob("*.yaml"))


def read_config(path: Path) -> Ros2Config:
    """Read a configuration; with `preset: NAME` it says only what differs from that. UsageError where it is wrong."""
    own = _read(path)
    preset = own.get("preset")
    if preset is not None:
        if preset not in known_presets():
            raise UsageError(f"{path}: preset: known are {', '.join(known_presets())}")
        own = _merged(_read(PRESETS / f"{preset}.yaml"), own)
    # YAML has lists, and a tuple is what does not change.
    if isinstance(own.get("stops"), list):
        own["stops"] = tuple(own["stops"])
    try:
        config = Ros2Config.model_validate(own)
        # Here, and not only where it drives: then nothing is started for a base that must not be driven.
        check_stopping(config)
    except ValidationError as error:
        raise UsageError(f"{path}: {_explained(error)}") from None
    except ServiceError as error:
        raise UsageError(f"{path}: {error}; services/ros2/README.md says what helps") from None
    return config


def _explained(error: ValidationError) -> str:
    errors = error.errors(include_url=False)
    missing = [".".join(map(str, one["loc"])) for one in errors if one["type"] == "missing"]
    if "watchdog_s" in missing:
        return (
            "watchdog_s: say after how many seconds without a command the base stands by itself; one that does not "
            "must not be driven (services/ros2/README.md says how it can)"
        )
    if len(missing) == len(errors) > 1:
        return (
            f"lacks {', '.join(missing)}; a preset has what is usual: {', '.join(known_presets())}"
        )
    if errors[0]["type"] == "value_error":  # one of our own, which says where
        return str(errors[0]["ctx"]["error"])
    return describe(error)


def _read(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            text = file.read(_LARGEST + 1)
        if len(text) > _LARGEST:
            raise UsageError(f"{path}: larger than {_LARGEST} bytes; this is no configuration")
        tree = YAML(typ="safe", pure=True).load(text.decode())
    except OSError as error:
        raise UsageError(
            f"{path}: {(error.strerror or str(error)).lower()}; presets: {', '.join(known_presets())}"
        ) from None
    except (YAMLError, ValueError, RecursionError) as error:
        reason = printable(" ".join(str(getattr(error, "problem", None) or error).split()))
        mark = getattr(error, "problem_mark", None)
        where = "" if mark is None else f" in line {mark.line + 1}"
        raise UsageError(f"{path}: no YAML{where}: {reason}") from None
    if not isinstance(tree, dict):
        raise UsageError(f"{path}: expected settings such as `preset: turtlebot4`")
    return tree


def _merged(base: dict[str, Any], own: dict[str, Any]) -> dict[str, Any]:
    both = dict(base)
    for key, value in own.items():
        was = both.get(key)
        both[key] = (
            _merged(was, value) if isinstance(was, dict) and isinstance(value, dict) else value
        )
    return both


class Ros2Settings(RobotSettings):
    """Which base."""

    ros2_config: Path
    """File that says which base this is, and how it is reached; it may begin with a preset."""
