"""Messages of the topics of a bag: their times, velocities and poses."""

import math
from array import array
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from schemas.codec import printable
from services.importers.bags import Received, decoded, header_of
from services.importers.clocks import Times
from services.importers.drive import MOST_SAMPLES, Array, ImportFailure
from services.importers.ticks import HOLD_S, LEAST_LINEAR, motion_along, moving
from services.kit.ros_message import heading_of

COMPRESSED: Final = "sensor_msgs/msg/CompressedImage"
RAW: Final = "sensor_msgs/msg/Image"
TWIST: Final = "geometry_msgs/msg/Twist"
STAMPED: Final = "geometry_msgs/msg/TwistStamped"
MEASURED: Final = "geometry_msgs/msg/TwistWithCovarianceStamped"
ODOMETRY: Final = "nav_msgs/msg/Odometry"
POSE: Final = "geometry_msgs/msg/PoseStamped"
ESTIMATE: Final = "geometry_msgs/msg/PoseWithCovarianceStamped"
INFO: Final = "sensor_msgs/msg/CameraInfo"
IMAGES: Final = (COMPRESSED, RAW)
VELOCITIES: Final = (TWIST, STAMPED, MEASURED, ODOMETRY)
POSES: Final = (ODOMETRY, POSE, ESTIMATE)
#: Columns of a stream: number in the file, times of reception and capture, velocities, pose.
_COLUMNS: Final = 9
_UNKNOWN: Final = (math.nan,) * 3
_DEPTH: Final = ("16UC1", "32FC1")


@dataclass
class Stream:
    """The messages of a topic."""

    topic: str
    type: str
    frame: str = ""  # Frame of the first header.
    depth: bool = False  # Whether images are distances.
    times_s: Array = field(default_factory=lambda: np.zeros(0))  # Times of capture, ascending.
    _values: "array[float]" = field(default_factory=lambda: array("d"))
    _rows: Array = field(default_factory=lambda: np.zeros((0, _COLUMNS)))  # In order of capture.

    def __len__(self) -> int:
        return len(self._values) // _COLUMNS

    def add(self, message: Received, number: int) -> None:
        """Add a message; ValueError if it does not fit its type."""
        if len(self) >= MOST_SAMPLES:
            raise ImportFailure(
                f"{printable(self.topic)}: too large (more than {MOST_SAMPLES} messages)"
            )
        stamp_s = math.nan
        if self.type != TWIST:
            header = header_of(message)
            stamp_s = header.stamp_s
            self.frame = self.frame or header.frame
        if self.type not in IMAGES:
            self._add(number, message, stamp_s, *_moving(self.type, decoded(message)))
            return
        if not self._values:
            image = decoded(message)
            form = image.encoding if self.type == RAW else image.format
            self.depth = form.startswith(_DEPTH) or "compressedDepth" in form
        self._add(number, message, stamp_s, _UNKNOWN, _UNKNOWN)

    def _add(
        self,
        number: int,
        message: Received,
        stamp_s: float,
        twist: Iterable[float],
        pose: Iterable[float],
    ) -> None:
        self._values.extend((number, message.time_s, stamp_s, *twist, *pose))

    def times(self) -> Times:
        """Return the times of the messages by all clocks, in the order of the file."""
        self._rows = np.array(self._values).reshape(-1, _COLUMNS)
        numbers, received_s, stamps_s = self._rows[:, :3].T.copy()
        large = self.type in IMAGES
        return Times(printable(self.topic), numbers.astype(np.int64), received_s, stamps_s, large)

    def settle(self, captured_s: Array) -> None:
        """Order the messages by their time of capture; omit those without."""
        order = np.argsort(captured_s, kind="stable")
        order = order[np.isfinite(captured_s[order])]
        self.times_s = captured_s[order]
        self._rows = self._rows[order]

    @property
    def numbers(self) -> NDArray[np.int64]:
        """Positions of the messages in the file, in the order of capture."""
        return self._rows[:, 0].astype(np.int64)

    @property
    def poses(self) -> Array:
        """Pose of each message, (n, 3); NaN without one."""
        return self._rows[:, 6:]

    @property
    def track(self) -> Array:
        """Time and pose, (n, 4); a heading that is unknown in all messages is 0."""
        poses = self.poses.copy()
        if np.isnan(poses[:, 2]).all():
            poses[:, 2] = 0.0
        return np.column_stack([self.times_s, poses])

    @property
    def reported(self) -> Array:
        """Time, speed ahead and turn rate of the messages, (n, 3); empty if they never move."""
        rows = np.column_stack([self.times_s, self._rows[:, [3, 5]]])
        return rows if self.type not in POSES or moving(rows).any() else rows[:0]

    @cached_property
    def motion(self) -> Array:
        """Time, speed ahead and turn rate (n, 3): as reported, or else along the poses."""
        reported = self.reported
        return reported if len(reported) else motion_along(self.track)

    @property
    def sideways_s(self) -> Array:
        """Times at which the velocity is mainly sideways."""
        ahead, aside, _ = np.abs(np.nan_to_num(self._rows[:, 3:6])).T
        mainly: Array = self.times_s[(aside > LEAST_LINEAR) & (aside > ahead)]
        return mainly

    def driven(self, at_s: Array) -> NDArray[np.bool_]:
        """Return at which times a velocity that moves the robot holds."""
        before = np.searchsorted(self.motion[:, 0], at_s, side="right") - 1
        held = (before >= 0) & (at_s - self.motion[before, 0] <= HOLD_S)
        return np.asarray(held & moving(self.motion)[before], dtype=bool)

    def beside(self, at_s: Array) -> float:
        """Return the share of times with a message beside."""
        after = np.clip(np.searchsorted(self.times_s, at_s), 1, self.times_s.size - 1)
        off_s = np.abs(self.times_s[[after - 1, after]] - at_s).min(axis=0)
        return float((off_s <= HOLD_S).mean())

    @property
    def text(self) -> str:
        """The topic, the number of its messages, and its rate."""
        count = self.times_s.size
        passed_s = float(np.ptp(self.times_s)) if count else 0.0
        rate = f", {(count - 1) / passed_s:.1f} Hz" if passed_s else ""
        return f"{printable(self.topic)} ({count} messages{rate})"


def _moving(kind: str, message: Any) -> tuple[Iterable[float], Iterable[float]]:  # noqa: ANN401
    """Return the velocities and the pose of a decoded message."""
    if kind == TWIST:
        return _twist(message), _UNKNOWN
    if kind == STAMPED:
        return _twist(message.twist), _UNKNOWN
    if kind == MEASURED:
        return _twist(message.twist.twist), _UNKNOWN
    if kind == ODOMETRY:
        return _twist(message.twist.twist), _planar(message.pose.pose)
    return _UNKNOWN, _planar(message.pose if kind == POSE else message.pose.pose)


def _twist(twist: Any) -> tuple[float, float, float]:  # noqa: ANN401 - its class is generated
    return twist.linear.x, twist.linear.y, twist.angular.z


def _planar(pose: Any) -> tuple[float, float, float]:  # noqa: ANN401 - as above
    """Return x, y and heading; NaN if the quaternion is no rotation, such as zero."""
    turn = pose.orientation
    # Products of numbers without meaning are infinite, but powers raise an error.
    norm = turn.w * turn.w + turn.x * turn.x + turn.y * turn.y + turn.z * turn.z
    heading = heading_of(turn) if norm > 0.5 else math.nan
    return pose.position.x, pose.position.y, heading
