"""A body, and a robot whose messages the test sends: no bus, and a clock that the test moves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.base import KEYS, Atom
from schemas.rpc import ResetRequest
from services.kit.node import ServiceError
from services.ros2 import messages
from services.ros2.body import Ros2Body
from services.ros2.clock import LEARN_S
from services.ros2.config import read_config
from services.ros2.messages import Messages
from services.ros2.senses import Senses
from tests.services.robot.line import Clock

ROS = Messages("jazzy")
PICTURE = np.kron(
    np.random.default_rng(1).integers(0, 255, (6, 8, 3), dtype=np.uint8),
    np.ones((8, 8, 1), np.uint8),
)
CAMERA = "/camera/image_raw/compressed"
ODOM = "/odom"
SCAN = "/scan"
HAZARDS = "/hazards"
IMU = "/imu"
BEGIN = ResetRequest(seed=1, mode="realtime")
# The robot's clock began at another time than ours.
AHEAD_S = 1_000_000.0


def header(at_s: float) -> dict[str, Any]:
    stamp_s = at_s + AHEAD_S
    return {"stamp": {"sec": int(stamp_s), "nanosec": int(stamp_s % 1 * 1e9)}}


class Air:
    """The link of a test: it keeps the orders sent."""

    def __init__(self) -> None:
        self.sent: list[tuple[float, float]] = []
        self.robot_s: float | None = None
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
        self,
        folder: Path,
        scan: str = "stop_m: 0.4, blind_m: 0.1",
        stops: str = "",
        preset: str = "generic",
    ) -> None:
        path = folder / "mine.yaml"
        path.write_text(
            f"preset: {preset}\nwatchdog_s: 0.2\nspeed_m_s: 0.5\nturn_rate_rad_s: 1.5\nbraking_s: 0.1\n"
            f"camera: {{latency_s: 0.0}}\nimu: {{topic: imu}}\nscan: {{topic: scan, {scan}}}\n"
            f"stops: [{{topic: hazards, type: irobot_create_msgs/msg/HazardDetectionVector}}{stops}]\n"
        )
        self.config = read_config(path)
        self.clock = Clock()
        self.air = Air()
        self.senses = Senses(self.config, self.clock)
        self.echoes = True  # Whether the robot's router returns echoes at once.
        self.body = Ros2Body(self.config, self.senses, self.air, self.clock)

    def says(self, topic: str, at_s: float | None = None, **fields: Any) -> None:
        """Send a message on a topic, stamped now by default."""
        if self.echoes:
            self.senses.echoed(self.clock.now_s)
        kind = self.senses.inputs[topic].type_name
        stamped = (
            {}
            if kind == messages.BOOL
            else {"header": header(self.clock.now_s if at_s is None else at_s)}
        )
        self.senses.take(topic, ROS.write(kind, stamped | fields))

    def picture(self, at_s: float | None = None, data: bytes | None = None) -> None:
        jpeg = cv2.imencode(".jpg", PICTURE)[1].tobytes() if data is None else data
        self.says(CAMERA, at_s, format="jpeg", data=np.frombuffer(jpeg, np.uint8))

    def wheels(
        self, x: float = 0.0, y: float = 0.0, heading: float = 0.0, at_s: float | None = None
    ) -> None:
        turned = {"z": math.sin(heading / 2), "w": math.cos(heading / 2)}
        self.says(ODOM, at_s, pose={"pose": {"position": {"x": x, "y": y}, "orientation": turned}})

    def scan(self, metres: float = 5.0, angle: float = 0.0, at_s: float | None = None) -> None:
        ranges = np.full(360, 5.0, np.float32)
        ranges[round(math.degrees(angle)) % 360] = metres
        ranges[90] = math.nan
        ranges[5] = 0.05  # a part of the robot
        self.scans(ranges, at_s)

    def scans(
        self,
        ranges: Sequence[float] | NDArray[np.float32],
        at_s: float | None = None,
        **fields: float,
    ) -> None:
        """Have the scanner tell some ranges: all around, from ahead to the left, unless the fields say otherwise."""
        told = {"angle_max": math.tau, "angle_increment": math.tau / max(1, len(ranges))}
        self.says(
            SCAN, at_s, **(told | {"range_min": 0.02, "range_max": 12.0} | fields), ranges=ranges
        )

    def hazards(self, *numbers: int, at_s: float | None = None) -> None:
        self.says(HAZARDS, at_s, detections=[{"type": number} for number in numbers])

    def may_go(self, atom: Atom) -> bool:
        """Whether the base is moved so."""
        try:
            self.body.drive(KEYS[atom])
        except ServiceError:
            return False
        return self.air.sent[-1] != (0.0, 0.0)

    def ways(self) -> str:
        """Return where it may go."""
        moves: tuple[Atom, ...] = ("forward", "backward", "left", "right")
        return " ".join(atom for atom in moves if self.may_go(atom))

    def passes(self, seconds: float, *silent: str, **others: Any) -> None:
        """Have time pass, and then all but the silent ones be heard."""
        self.clock.now_s += seconds
        takes = {
            "wheels": self.wheels,
            "scan": self.scan,
            "hazards": self.hazards,
            "picture": self.picture,
        }
        for name, take in takes.items():
            if name not in silent:
                take(**others)

    def known(self, *pose: float) -> Rig:
        """Have everything be heard for long enough."""
        for seconds in (0.01, LEARN_S):
            self.passes(seconds, "wheels")
            self.wheels(*pose)
        return self

    def begun(self) -> Rig:
        self.known().body.begin(BEGIN)
        self.body.look(0)
        self.clock.now_s += 0.01
        return self
