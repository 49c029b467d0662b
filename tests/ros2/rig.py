"""A body, and a robot whose messages the test sends; no bus, and time as the test has it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

from schemas.base import Atom
from schemas.rpc import ResetRequest
from services.kit.node import ServiceError
from services.ros2 import messages
from services.ros2.body import Ros2Body
from services.ros2.clock import LEARN_S
from services.ros2.config import Ros2Config, read_config
from services.ros2.messages import Messages
from services.ros2.senses import Senses
from tests.services.robot.line import Clock

STORE = get_typestore(Stores.ROS2_JAZZY)
T = STORE.types
OURS = Messages("jazzy")
PICTURE = np.kron(np.random.default_rng(1).integers(0, 255, (6, 8, 3), dtype=np.uint8), np.ones((8, 8, 1), np.uint8))
CAMERA, ODOM, SCAN, HAZARDS, IMU = "/camera/image_raw/compressed", "/odom", "/scan", "/hazards", "/imu"
# The robot's clock began at another time than ours.
AHEAD_S = 1_000_000.0


def header(at_s: float) -> Any:
    stamp_s = at_s + AHEAD_S
    return T["std_msgs/msg/Header"](T["builtin_interfaces/msg/Time"](int(stamp_s), int(stamp_s % 1 * 1e9)), "")


class Air:
    """The link of a test: keeps what was sent."""

    def __init__(self) -> None:
        self.sent: list[tuple[float, float]] = []
        self.lack: str | None = None

    def send(self, ahead_m_s: float, turn_rad_s: float, robot_s: float | None) -> None:
        self.sent.append((ahead_m_s, turn_rad_s))
        self.robot_s = robot_s

    def lacks(self) -> str | None:
        return self.lack

    def detail(self) -> dict[str, str | int | float | bool | None]:
        return {}


class Rig:
    """A body, and a robot whose messages the test sends.

    Parameters
    ----------
    folder
        For its configuration.
    scan, stops
        What that says of the scanner, and more of what stops it.
    preset
        What it begins with.
    """

    def __init__(
        self, folder: Path, scan: str = "stop_m: 0.4, blind_m: 0.1", stops: str = "", preset: str = "generic"
    ) -> None:
        path = folder / "mine.yaml"
        path.write_text(
            f"preset: {preset}\nwatchdog_s: 0.2\nspeed_m_s: 0.5\nturn_rate_rad_s: 1.5\nbraking_s: 0.1\n"
            f"camera: {{latency_s: 0.0}}\nimu: {{topic: imu}}\nscan: {{topic: scan, {scan}}}\n"
            f"stops: [{{topic: hazards, type: irobot_create_msgs/msg/HazardDetectionVector}}{stops}]\n"
        )
        self.config: Ros2Config = read_config(path)
        self.clock = Clock()
        self.air = Air()
        self.senses = Senses(self.config, self.clock)
        self.body = Ros2Body(self.config, self.senses, self.air, self.clock)

    def picture(self, at_s: float | None = None, data: bytes | None = None) -> None:
        jpeg = cv2.imencode(".jpg", PICTURE)[1].tobytes() if data is None else data
        message = T[messages.COMPRESSED_IMAGE](header(self.at(at_s)), "jpeg", np.frombuffer(jpeg, np.uint8))
        self.senses.take(CAMERA, bytes(STORE.serialize_cdr(message, messages.COMPRESSED_IMAGE)))

    def wheels(self, x: float = 0.0, y: float = 0.0, heading: float = 0.0, at_s: float | None = None) -> None:
        vector, nothing = T["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0), np.zeros(36)
        turned = T["geometry_msgs/msg/Quaternion"](0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2))
        pose = T["geometry_msgs/msg/Pose"](T["geometry_msgs/msg/Point"](x, y, 0.0), turned)
        message = T[messages.ODOMETRY](
            header(self.at(at_s)),
            "base",
            T["geometry_msgs/msg/PoseWithCovariance"](pose, nothing),
            T["geometry_msgs/msg/TwistWithCovariance"](T[messages.TWIST](vector, vector), nothing),
        )
        self.senses.take(ODOM, bytes(STORE.serialize_cdr(message, messages.ODOMETRY)))

    def scan(self, metres: float = 5.0, angle: float = 0.0) -> None:
        ranges = np.full(360, 5.0, np.float32)
        ranges[round(math.degrees(angle)) % 360] = metres
        ranges[90] = math.nan
        ranges[5] = 0.05  # a part of the robot
        self.scans(ranges)

    def scans(self, ranges: Sequence[float] | NDArray[np.float32], at_s: float | None = None, **fields: float) -> None:
        """Have the scanner tell some ranges: all around, from ahead to the left, unless the fields say otherwise."""
        told = {"angle_min": 0.0, "angle_max": math.tau, "angle_increment": math.tau / max(1, len(ranges))}
        told |= {"time_increment": 0.0, "scan_time": 0.1, "range_min": 0.02, "range_max": 12.0} | fields
        beams, none = np.asarray(ranges, np.float32), np.zeros(0, np.float32)
        message = T[messages.LASER_SCAN](header(self.at(at_s)), **told, ranges=beams, intensities=none)
        self.senses.take(SCAN, bytes(STORE.serialize_cdr(message, messages.LASER_SCAN)))

    def says(self, topic: str, *, pressed: bool) -> None:
        """Have a button say whether it is pressed."""
        self.senses.take(topic, bytes(STORE.serialize_cdr(T[messages.BOOL](pressed), messages.BOOL)))

    def may_go(self, atom: Atom) -> bool:
        """Whether the base is moved so."""
        try:
            self.body.drive(atom, 1.0)
        except ServiceError:
            return False
        return self.air.sent[-1] != (0.0, 0.0)

    def hazards(self, *numbers: int, at_s: float | None = None) -> None:
        types = OURS._store.types
        found = [types["irobot_create_msgs/msg/HazardDetection"](header(self.at(at_s)), number) for number in numbers]
        self.senses.take(HAZARDS, OURS.write(messages.HAZARDS, types[messages.HAZARDS](header(self.at(at_s)), found)))

    def at(self, at_s: float | None = None) -> float:
        return self.clock.now_s if at_s is None else at_s

    def all(self, x: float = 0.0, y: float = 0.0, heading: float = 0.0) -> None:
        """Have everything be heard, now."""
        self.clock.now_s += 0.01
        self.wheels(x, y, heading)
        self.scan()
        self.hazards()
        self.picture()

    def known(self, *pose: float) -> Rig:
        """Have everything be heard for long enough."""
        self.all(*pose)
        self.clock.now_s += LEARN_S
        self.all(*pose)
        return self

    def begun(self) -> Rig:
        self.known().body.begin(ResetRequest(seed=1, mode="realtime"))
        self.body.look(0)
        self.clock.now_s += 0.01
        return self
