"""Configuration of a base: topics, types and speeds, from a file that can extend a preset."""

from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from schemas.codec import describe, printable
from services.kit.bus import BusError, host_and_port
from services.kit.errors import UsageError
from services.kit.node import ServiceError
from services.robot.clock import SILENCE_S
from services.robot.loop import check_stopping
from services.robot.service import RobotSettings
from services.ros2 import messages
from services.ros2.messages import Distribution
from services.ros2.wire import DialectName, qualified

PRESETS: Final = Path(__file__).parent / "presets"
_LARGEST: Final = 65536  # Maximum size; a configuration is a page of text.
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Seconds = Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)]
#: Silence after which the robot is not moved.
Silence = Annotated[float, Field(gt=0, le=10, allow_inf_nan=False)]
Angle = Annotated[float, Field(gt=0, lt=3.15)]
#: A name; relative to the namespace unless it begins with a slash.
Topic = Annotated[str, Field(pattern=r"^/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*$")]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")


class CameraTopics(_Part):
    """Topics of the images, as JPEG or pixels (rgb8, bgr8, mono8, yuv422), and of the calibration."""

    topic: Topic
    type: Literal["sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image"] = (
        messages.COMPRESSED_IMAGE
    )
    info: Topic | None = None
    latency_s: Seconds = 0.0  # From the exposure to the stamp of an image.


class Input(_Part):
    """A subscribed topic."""

    topic: Topic
    silence_s: Silence = SILENCE_S


class ScanTopic(Input):
    """A laser scanner, or a similar source of distances; scanners turn 5 to 10 times a second."""

    silence_s: Silence = 0.5
    stop_m: Positive  # Distance from the scanner within which an obstacle forbids the movement.
    #: Direction ahead in the scanner's own angles, counter-clockwise; and the checked angle to both
    #: sides of the way.
    ahead_rad: Annotated[float, Field(gt=-3.15, lt=3.15)] = 0.0
    half_angle_rad: Angle = 0.6
    blind_m: Seconds = 0.0  # Distance within which readings are parts of the robot.
    #: Maximum angle of a way without readings; at 0.3 m a table's leg of 6 cm has this width.
    gap_rad: Angle = 0.2
    #: Whether a range of 0 means out of reach; covered or broken scanners report the same.
    zero_is_free: bool = False
    #: Whether the way back must be known to be free as well; false for a scanner that only looks
    #: ahead.
    behind: bool = True

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.blind_m >= self.stop_m:
            raise ValueError(
                f"scan: blind_m ({self.blind_m:g} m) must be less than stop_m ({self.stop_m:g} m), "
                "or no obstacle stops the robot"
            )
        return self


class StopTopic(_Part):
    """A topic that forbids movement: a bumper, a cliff sensor, or a button (a Bool of True)."""

    topic: Topic
    type: Literal[
        "irobot_create_msgs/msg/HazardDetectionVector",
        "turtlebot3_msgs/msg/SensorState",
        "std_msgs/msg/Bool",
    ]
    #: None for a topic that publishes only changes: one message is required since its publisher and
    #: this process started.
    silence_s: Silence | None = 0.5


class VelocityTopic(_Part):
    """Topic of the base's velocity; auto selects the type that it subscribes to."""

    topic: Topic = "cmd_vel"
    type: Literal[
        "auto", "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped",
        "ackermann_msgs/msg/AckermannDrive", "ackermann_msgs/msg/AckermannDriveStamped",
    ] = "auto"  # fmt: skip
    # From axle to axle, for AckermannDrive.
    wheelbase_m: Annotated[float | None, Field(gt=0, le=10)] = None


class Ros2Config(_Part):
    """A base with a camera; for the settings see services/ros2/README.md."""

    preset: str | None = None
    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,31}$")]
    router: str = "tcp/127.0.0.1:7447"
    dialect: DialectName = "rmw_zenoh"
    distribution: Distribution = "jazzy"
    domain: Annotated[int, Field(ge=0, le=232)] = 0
    namespace: Annotated[str, Field(pattern=r"^(/[A-Za-z_][A-Za-z0-9_]*)*$")] = ""
    speed_m_s: Positive
    turn_rate_rad_s: Positive
    # Minimum turning radius of a car; 0 if it turns on the spot.
    radius_m: Annotated[float, Field(ge=0, le=100)] = 0.0
    braking_s: Seconds  # From nominal speed to standstill.
    #: Time without a command after which the base stops by itself; a base without a watchdog must
    #: not be driven.
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
        velocity_type = self.velocity.type
        car = self.velocity.wheelbase_m is not None
        if velocity_type != "auto" and ("Ackermann" in velocity_type) != car:
            raise ValueError("velocity: wheelbase_m is required for AckermannDrive, and only there")
        if car and self.radius_m == 0.0:
            raise ValueError(
                "radius_m: required for AckermannDrive (minimum turning radius, metres)"
            )
        return self

    def full(self, topic: str) -> str:
        """Return the full name of a topic."""
        return qualified(topic, self.namespace)


def known_presets() -> list[str]:
    """Return the names of the presets, sorted."""
    return sorted(path.stem for path in PRESETS.glob("*.yaml"))


def read_config(path: Path) -> Ros2Config:
    """Read a configuration, merged into its `preset` if given; UsageError if it is invalid."""
    own = _read(path)
    preset = own.get("preset")
    if preset is not None:
        if preset not in known_presets():
            raise UsageError(f"{path}: preset not found; available: {', '.join(known_presets())}")
        own = _merged(_read(PRESETS / f"{preset}.yaml"), own)
    # YAML has lists, while the frozen model has tuples.
    if isinstance(own.get("stops"), list):
        own["stops"] = tuple(own["stops"])
    try:
        config = Ros2Config.model_validate(own)
        # Checked here as well, so that no process starts for a base that must not be driven.
        check_stopping(config)
    except ValidationError as error:
        raise UsageError(f"{path}: {_explained(error)}") from None
    except ServiceError as error:
        raise UsageError(f"{path}: {error}; for help see services/ros2/README.md") from None
    return config


def _explained(error: ValidationError) -> str:
    errors = error.errors(include_url=False)
    missing = [".".join(map(str, one["loc"])) for one in errors if one["type"] == "missing"]
    if "watchdog_s" in missing:
        return (
            "watchdog_s: required; give the seconds without a command after which the base stops "
            "by itself (for a base without a watchdog see services/ros2/README.md)"
        )
    if len(missing) == len(errors) > 1:
        return f"missing {', '.join(missing)}; presets with defaults: {', '.join(known_presets())}"
    if errors[0]["type"] == "value_error":  # A validator of ours, whose text names the setting.
        return str(errors[0]["ctx"]["error"])
    return describe(error)


def _read(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            text = file.read(_LARGEST + 1)
        if len(text) > _LARGEST:
            raise UsageError(f"{path}: too large for a configuration (maximum {_LARGEST} bytes)")
        tree = YAML(typ="safe", pure=True).load(text.decode())
    except OSError as error:
        raise UsageError(
            f"{path}: {(error.strerror or str(error)).lower()}; presets: {', '.join(known_presets())}"
        ) from None
    except (YAMLError, ValueError, RecursionError) as error:
        reason = printable(" ".join(str(getattr(error, "problem", None) or error).split()))
        mark = getattr(error, "problem_mark", None)
        where = "" if mark is None else f" in line {mark.line + 1}"
        raise UsageError(f"{path}: invalid YAML{where}: {reason}") from None
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
    """Settings of the base."""

    ros2_config: Path
    """Configuration file of the base, which can begin with a preset."""
