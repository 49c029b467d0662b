"""ROS 2 messages: their bytes (CDR) and the hashes of their types, both by the `rosbags` package."""

import math
from functools import cache
from typing import Any, Final, Literal, TypeAlias

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from services.kit.ros_message import ros_message

Distribution = Literal["humble", "iron", "jazzy", "kilted", "lyrical"]
# A message, or a part of one: its class is created from its definition at run time.
RosMessage: TypeAlias = Any

TWIST: Final = "geometry_msgs/msg/Twist"
TWIST_STAMPED: Final = "geometry_msgs/msg/TwistStamped"
ACKERMANN: Final = "ackermann_msgs/msg/AckermannDrive"
ACKERMANN_STAMPED: Final = "ackermann_msgs/msg/AckermannDriveStamped"
#: Without a stamp and with one, of a base and of a car.
VELOCITIES: Final = (TWIST, TWIST_STAMPED), (ACKERMANN, ACKERMANN_STAMPED)
COMPRESSED_IMAGE: Final = "sensor_msgs/msg/CompressedImage"
IMAGE: Final = "sensor_msgs/msg/Image"
CAMERA_INFO: Final = "sensor_msgs/msg/CameraInfo"
ODOMETRY: Final = "nav_msgs/msg/Odometry"
IMU: Final = "sensor_msgs/msg/Imu"
LASER_SCAN: Final = "sensor_msgs/msg/LaserScan"
BOOL: Final = "std_msgs/msg/Bool"
HAZARDS: Final = "irobot_create_msgs/msg/HazardDetectionVector"
SENSOR_STATE: Final = "turtlebot3_msgs/msg/SensorState"

# The last moment that a stamp, which has 32 bits of seconds, can hold.
_LAST_NS: Final = (2**31 - 1) * 1_000_000_000
# Messages of bases that the distributions do not contain.
_MORE: Final = {
    "irobot_create_msgs/msg/HazardDetection": "std_msgs/Header header\nuint8 type\n",
    HAZARDS: "std_msgs/Header header\nirobot_create_msgs/HazardDetection[] detections\n",
    ACKERMANN: "float32 steering_angle\nfloat32 steering_angle_velocity\nfloat32 speed\nfloat32 acceleration\n"
    "float32 jerk\n",
    ACKERMANN_STAMPED: "std_msgs/Header header\nackermann_msgs/AckermannDrive drive\n",
    SENSOR_STATE: "std_msgs/Header header\nuint8 bumper\nfloat32 cliff\nfloat32 sonar\nfloat32 illumination\n"
    "uint8 led\nuint8 button\nbool torque\nint32 left_encoder\nint32 right_encoder\nfloat32 battery\n",
}


class MessageError(Exception):
    """Bytes that do not match their type; the text gives the reason in one line."""


@cache
def _store(distribution: Distribution) -> RosMessage:
    store = get_typestore(Stores(f"ros2_{distribution}"))
    types: dict[str, Any] = {}
    for name, text in _MORE.items():
        types |= get_types_from_msg(text, name)
    store.register(types)
    return store


class Messages:
    """Encodes and decodes the messages of a ROS 2 distribution."""

    def __init__(self, distribution: Distribution) -> None:
        self._store = _store(distribution)

    def type_hash(self, type_name: str) -> str:
        """Return the hash of a type's definition, ``RIHS01_…``."""
        return str(self._store.hash_rihs01(type_name))

    def write(self, type_name: str, fields: dict[str, Any]) -> bytes:
        """Return the bytes of a message with these fields, see `ros_message`."""
        return bytes(
            self._store.serialize_cdr(ros_message(self._store, type_name, fields), type_name)
        )

    def read(self, type_name: str, payload: bytes) -> RosMessage:
        """Decode a message; MessageError for invalid bytes."""
        try:
            return self._store.deserialize_cdr(payload, type_name)
        except Exception as error:  # noqa: BLE001 - undocumented errors for untrusted bytes
            raise MessageError(f"not a {type_name}: {type(error).__name__}") from None

    def velocity(
        self,
        ahead_m_s: float,
        turn_rad_s: float,
        stamp_ns: int | None,
        wheelbase_m: float | None = None,
    ) -> bytes:
        """Return a Twist, TwistStamped, AckermannDrive or AckermannDriveStamped as bytes.

        Parameters
        ----------
        ahead_m_s, turn_rad_s
            Speed ahead, and turn rate counter-clockwise.
        stamp_ns
            Stamp by the robot's clock, nanoseconds since 1970, clipped to its range; 0 if unknown,
            None for a type without a stamp.
        wheelbase_m
            From axle to axle, for AckermannDrive: its steering angle to the left gives the turn
            rate, and is 0 in standing.
        """
        plain, stamped = VELOCITIES[wheelbase_m is not None]
        part = "twist"
        fields = dict[str, Any](linear={"x": ahead_m_s}, angular={"z": turn_rad_s})
        if wheelbase_m is not None:
            angle_rad = math.atan(wheelbase_m * turn_rad_s / ahead_m_s) if ahead_m_s else 0.0
            part = "drive"
            fields = {"speed": ahead_m_s, "steering_angle": angle_rad}
        if stamp_ns is None:
            return self.write(plain, fields)
        seconds, rest_ns = divmod(min(max(0, stamp_ns), _LAST_NS), 1_000_000_000)
        header = {"stamp": {"sec": seconds, "nanosec": rest_ns}, "frame_id": "base_link"}
        return self.write(stamped, {"header": header, part: fields})
