"""Configuration of a base: topics, types and speeds, from a file that can extend a preset."""

from pathlib import Path
from typing import Annotated, Final, Literal, Self

from pydantic import Field, Strict, model_validator

from services.kit.bus import BusError, host_and_port
from services.robot import real
from services.robot.clock import SILENCE_S
from services.robot.real import BaseConfig, ConfigPart, Positive, Seconds, Silence
from services.ros2 import messages
from services.ros2.messages import Distribution
from services.ros2.wire import DialectName, qualified

PRESETS: Final = Path(__file__).parent / "presets"
Angle = Annotated[float, Field(gt=0, lt=3.15)]
#: A name; relative to the namespace unless it begins with a slash.
Topic = Annotated[str, Field(pattern=r"^/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*$")]


class CameraTopics(ConfigPart):
    """Topics of the images, as JPEG or pixels (rgb8, bgr8, mono8, yuv422), and of the calibration."""

    topic: Topic
    type: Literal["sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image"] = (
        messages.COMPRESSED_IMAGE
    )
    info: Topic | None = None
    latency_s: Seconds = 0.0  # From the exposure to the stamp of an image.


class Input(ConfigPart):
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


class StopTopic(ConfigPart):
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


class VelocityTopic(ConfigPart):
    """Topic of the base's velocity; auto selects the type that it subscribes to."""

    topic: Topic = "cmd_vel"
    type: Literal[
        "auto", "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped",
        "ackermann_msgs/msg/AckermannDrive", "ackermann_msgs/msg/AckermannDriveStamped",
    ] = "auto"  # fmt: skip
    # From axle to axle, for AckermannDrive.
    wheelbase_m: Annotated[float | None, Field(gt=0, le=10)] = None


class Ros2Config(BaseConfig):
    """A base with a camera; for the settings see services/ros2/README.md."""

    router: str = "tcp/127.0.0.1:7447"
    dialect: DialectName = "rmw_zenoh"
    distribution: Distribution = "jazzy"
    domain: Annotated[int, Field(ge=0, le=232)] = 0
    namespace: Annotated[str, Field(pattern=r"^(/[A-Za-z_][A-Za-z0-9_]*)*$")] = ""
    velocity: VelocityTopic = VelocityTopic()
    camera: CameraTopics
    odometry: Input | None = None  # The wheels; their silence is the base's.
    imu: Input | None = None
    scan: ScanTopic | None = None
    stops: Annotated[tuple[StopTopic, ...], Strict(False)] = ()

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


def read_config(path: Path) -> Ros2Config:
    """Read the configuration of a base; UsageError if it is invalid."""
    return real.read_config(path, Ros2Config, PRESETS)
