"""What a robot's messages say: its newest frame, its wheels, its inertial unit, and what forbids to go on."""

from __future__ import annotations

import logging
import math
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from threading import Lock
from typing import Final

import numpy as np
from numpy.typing import NDArray

from schemas.base import ATOMS, Atom
from schemas.imu import MAX_SAMPLES
from services.kit.jpeg import decode_jpeg
from services.kit.node import Throttle
from services.kit.raw_image import rgb_of
from services.robot.body import ImuReading, OdometryReading, Triple
from services.robot.clock import now_s
from services.ros2 import messages
from services.ros2.clock import StampedClock
from services.ros2.config import Ros2Config, Scan
from services.ros2.messages import MessageError, Messages, RosMessage

#: Wheels that were read within this time of a frame are looked through for those of its moment.
_KEPT: Final = 100
# Poses further apart than the base can have gone, by this much, are of wheels that began to count anew.
_LEAP_M, _LEAP_RAD = 0.3, 0.3
#: As `schemas.imu` has it; and far more than any base does.
_MOST_RAD_S, _MOST_M_S2, _MOST_M_S = 100.0, 1000.0, 100.0
_MOVING: Final = frozenset(ATOMS) - {"stop"}
# Of irobot_create_msgs/msg/HazardDetection, by number: what it forbids, and its name.
_HAZARDS: Final[dict[int, tuple[str, frozenset[Atom]]]] = {
    0: ("it may not back further", frozenset({"backward"})),
    1: ("its bumper is pressed", _MOVING - {"backward"}),
    2: ("it stands before a cliff", _MOVING - {"backward"}),
    3: ("its wheels are stalled", _MOVING),
    4: ("a wheel hangs in the air", _MOVING),
    5: ("something is near its front", frozenset({"forward"})),
}
_BUMP: Final = 1
# Of turtlebot3_msgs/msg/SensorState.
_BUMPER_FORWARD, _BUMPER_BACKWARD = 1, 2
_log = logging.getLogger("ros2")


@dataclass(frozen=True, eq=False)
class Frame:
    """A picture, still as it came.

    Attributes
    ----------
    message
        CompressedImage or Image.
    captured_s
        When the light fell in, by our clock.
    """

    message: RosMessage
    captured_s: float


@dataclass(frozen=True)
class Wheels:
    """Where the wheels say that the base is, since we listen.

    Attributes
    ----------
    read_s
        When, by our clock.
    ahead_m
        The way so far, backwards less.
    """

    read_s: float
    x_m: float
    y_m: float
    heading_rad: float
    ahead_m: float
    turned_rad: float


class Track:
    """Adds up what the wheels say, so that a base whose count begins anew does not leap.

    Parameters
    ----------
    speed_m_s, turn_rate_rad_s
        What the base does at most; twice of it is believed.
    silence_s
        After so much silence the count may have begun anew: it has where it is nearer to nothing than to what it was.
    """

    def __init__(self, speed_m_s: float, turn_rate_rad_s: float, silence_s: float) -> None:
        self._silence_s = silence_s
        self._speed_m_s = speed_m_s
        self._turn_rate_rad_s = turn_rate_rad_s
        self._raw: tuple[float, float, float] | None = None
        self._now = Wheels(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        #: How many times it leapt.
        self.leaps = 0

    def add(self, read_s: float, x_m: float, y_m: float, heading_rad: float) -> Wheels:
        """Take the next pose."""
        now, raw = self._now, self._raw
        self._raw = x_m, y_m, heading_rad
        if raw is None:
            self._now = Wheels(read_s, 0.0, 0.0, 0.0, 0.0, 0.0)
            return self._now
        turned = math.remainder(heading_rad - raw[2], math.tau)
        dx, dy = x_m - raw[0], y_m - raw[1]
        passed_s = max(0.0, read_s - now.read_s)
        far = math.hypot(dx, dy) > _LEAP_M + 2 * self._speed_m_s * passed_s
        far |= abs(turned) > _LEAP_RAD + 2 * self._turn_rate_rad_s * passed_s
        if passed_s > self._silence_s:
            far |= _size(x_m, y_m, math.remainder(heading_rad, math.tau)) < _size(dx, dy, turned)
        if far:
            self.leaps += 1
            dx = dy = turned = 0.0
        # What was gone is seen from where the base stood, and laid on to where we say that it stood.
        by = now.heading_rad - raw[2]
        middle = raw[2] + turned / 2
        self._now = Wheels(
            read_s,
            now.x_m + dx * math.cos(by) - dy * math.sin(by),
            now.y_m + dx * math.sin(by) + dy * math.cos(by),
            math.remainder(now.heading_rad + turned, math.tau),
            now.ahead_m + dx * math.cos(middle) + dy * math.sin(middle),
            now.turned_rad + turned,
        )
        return self._now


def _size(x_m: float, y_m: float, angle_rad: float) -> float:
    return math.hypot(x_m / _LEAP_M, y_m / _LEAP_M, angle_rad / _LEAP_RAD)


class Senses:
    """Takes a robot's messages on whatever thread they come, and tells the newest of it.

    Parameters
    ----------
    config
        Which topics there are.
    clock
        The actuator's seconds.
    """

    def __init__(self, config: Ros2Config, clock: Callable[[], float] = now_s) -> None:
        self.config = config
        self._messages = Messages(config.distribution)
        self._clock = clock
        self._lock = Lock()
        self._heard_s: dict[str, float] = {}
        self._silences: dict[str, float] = {}
        self.camera_clock = StampedClock()
        self._odometry_clock, self._imu_clock = StampedClock(), StampedClock()
        self._frame: Frame | None = None
        self._wheels: deque[Wheels] = deque(maxlen=_KEPT)
        self._imu: deque[ImuReading] = deque(maxlen=MAX_SAMPLES)
        silence_s = 0.0 if config.odometry is None else config.odometry.silence_s
        self.track = Track(config.speed_m_s, config.turn_rate_rad_s, silence_s)
        self._focal: tuple[float, int] | None = None
        self._forbidden: dict[str, tuple[tuple[str, frozenset[Atom]], ...]] = {}
        #: Whether the bumper was pressed since this was last set.
        self.touched = False
        #: Messages that were none, or not newer than the one before, by topic.
        self.refused: Counter[str] = Counter()
        self._complaints = Throttle()
        self.inputs = self._plan()

    def _plan(self) -> dict[str, tuple[str, Callable[[RosMessage, float], None]]]:
        """Return what is listened to: by topic its type, and what takes it."""
        config = self.config
        inputs: dict[str, tuple[str, Callable[[RosMessage, float], None]]] = {}
        inputs[config.full(config.camera.topic)] = (str(config.camera.type), self._see)
        if config.camera.info is not None:
            inputs[config.full(config.camera.info)] = (messages.CAMERA_INFO, self._calibrate)
        if config.odometry is not None:
            inputs[config.full(config.odometry.topic)] = (messages.ODOMETRY, self._roll)
            self._silences[config.full(config.odometry.topic)] = config.odometry.silence_s
        if config.imu is not None:
            inputs[config.full(config.imu.topic)] = (messages.IMU, self._feel)
        if config.scan is not None:
            inputs[config.full(config.scan.topic)] = (messages.LASER_SCAN, self._scan)
            self._silences[config.full(config.scan.topic)] = config.scan.silence_s
        for stop in config.stops:
            topic = config.full(stop.topic)
            inputs[topic] = (str(stop.type), self._stopper(topic, str(stop.type)))
            if stop.silence_s is not None:
                self._silences[topic] = stop.silence_s
        return inputs

    # -- what comes -----------------------------------------------------------------------------------------------

    def take(self, topic: str, payload: bytes) -> None:
        """Take the bytes of a message; whatever they are, nothing is raised."""
        arrived_s = self._clock()
        type_name, handler = self.inputs[topic]
        try:
            message = self._messages.read(type_name, payload)
            with self._lock:
                handler(message, arrived_s)
                self._heard_s[topic] = arrived_s
        except MessageError as error:
            self.refuse(topic, str(error))

    def refuse(self, topic: str, why: str) -> None:
        """Count a message that is not taken."""
        self.refused[topic] += 1
        if self._complaints.due():
            _log.warning("%s: message refused (%d so far): %s", topic, self.refused[topic], why)

    def _see(self, message: RosMessage, arrived_s: float) -> None:
        captured_s = _made_s(self.camera_clock, message, arrived_s)
        self._frame = Frame(message, captured_s - self.config.camera.latency_s)

    def _calibrate(self, message: RosMessage, _arrived_s: float) -> None:
        focal_px, width = float(message.k[0]), int(message.width)
        if not (math.isfinite(focal_px) and focal_px > 0 and width > 0):
            raise MessageError("no focal length in it; the camera is not calibrated")
        self._focal = focal_px, width

    def _roll(self, message: RosMessage, arrived_s: float) -> None:
        pose = message.pose.pose
        q = pose.orientation
        heading_rad = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))
        _check_finite("pose", (pose.position.x, pose.position.y, heading_rad), 1e6)
        read_s = _made_s(self._odometry_clock, message, arrived_s)
        self._wheels.append(self.track.add(read_s, pose.position.x, pose.position.y, heading_rad))

    def _feel(self, message: RosMessage, arrived_s: float) -> None:
        turn, push = _triple(message.angular_velocity), _triple(message.linear_acceleration)
        _check_finite("angular velocity", turn, _MOST_RAD_S)
        _check_finite("acceleration", push, _MOST_M_S2)
        self._imu.append(ImuReading(_made_s(self._imu_clock, message, arrived_s), turn, push))

    def _scan(self, message: RosMessage, _arrived_s: float) -> None:
        assert self.config.scan is not None  # noqa: S101 - it is listened to
        topic, scan = self.config.full(self.config.scan.topic), self.config.scan
        front_m, back_m = nearest_m(message, scan)
        forbidden: list[tuple[str, frozenset[Atom]]] = []
        if front_m < scan.stop_m:
            forbidden.append((f"something is {front_m:.2f} m ahead", frozenset({"forward"})))
        if back_m < scan.stop_m:
            forbidden.append((f"something is {back_m:.2f} m behind", frozenset({"backward"})))
        self._forbidden[topic] = tuple(forbidden)

    def _stopper(self, topic: str, type_name: str) -> Callable[[RosMessage, float], None]:
        read = {messages.HAZARDS: _hazards, messages.SENSOR_STATE: _bumpers, messages.BOOL: _button}[type_name]

        def take(message: RosMessage, _arrived_s: float) -> None:
            touched, forbidden = read(message)
            self.touched |= touched
            self._forbidden[topic] = forbidden

        return take

    # -- what is known --------------------------------------------------------------------------------------------

    def forbids(self, atom: Atom) -> str | None:
        """Say why the base must not make a movement; None where it may."""
        for topic, forbidden in list(self._forbidden.items()):
            for why, atoms in forbidden:
                if atom in atoms:
                    return f"{why} ({topic})"
        return None

    def silent(self) -> str | None:
        """Say who must be heard for the base to be moved, and is not; None where everybody is."""
        now = self._clock()
        for topic, silence_s in self._silences.items():
            heard_s = self._heard_s.get(topic)
            if heard_s is None:
                return f"nothing has come from {topic}"
            if now - heard_s > silence_s:
                return f"nothing has come from {topic} for {now - heard_s:.1f} s"
        return None

    def frame(self) -> Frame | None:
        """Return the newest frame."""
        return self._frame

    def focal_px(self, width: int) -> float | None:
        """Return the focal length in an image of so many columns, if the camera has told it."""
        return None if self._focal is None else self._focal[0] * width / self._focal[1]

    def wheels_at(self, at_s: float) -> Wheels | None:
        """Return what the wheels said nearest to a moment."""
        with self._lock:
            return min(self._wheels, key=lambda one: abs(one.read_s - at_s), default=None)

    def imu_since_last(self) -> list[ImuReading]:
        """Return the inertial readings since this was last called, by our clock."""
        with self._lock:
            readings = list(self._imu)
            self._imu.clear()
        return readings


def reading(now: Wheels, since: Wheels, last: Wheels) -> OdometryReading:
    """Return what the wheels say now, from where they were when an episode began, and when they were last read."""
    dx, dy = now.x_m - since.x_m, now.y_m - since.y_m
    cos, sin = math.cos(since.heading_rad), math.sin(since.heading_rad)
    elapsed_s = now.read_s - last.read_s
    speed_m_s = (now.ahead_m - last.ahead_m) / elapsed_s if elapsed_s > 0 else 0.0
    turn_rad_s = (now.turned_rad - last.turned_rad) / elapsed_s if elapsed_s > 0 else 0.0
    return OdometryReading(
        dx * cos + dy * sin,
        dy * cos - dx * sin,
        math.remainder(now.heading_rad - since.heading_rad, math.tau),
        min(max(speed_m_s, -_MOST_M_S), _MOST_M_S),
        min(max(turn_rad_s, -_MOST_RAD_S), _MOST_RAD_S),
    )


def nearest_m(message: RosMessage, scan: Scan) -> tuple[float, float]:
    """Return how far the nearest thing is ahead, and behind, in metres; infinity where there is none."""
    ranges = np.asarray(message.ranges, dtype=np.float64)
    angles = message.angle_min + message.angle_increment * np.arange(ranges.size) - scan.ahead_rad
    off = np.abs(np.arctan2(np.sin(angles), np.cos(angles)))
    # What the scanner does not see is not a number, infinite or 0; nearer than its least range it sees nothing.
    seen = np.isfinite(ranges) & (ranges > max(scan.blind_m, float(message.range_min)))
    ahead, behind = seen & (off <= scan.half_angle_rad), seen & (off >= math.pi - scan.half_angle_rad)
    return float(ranges[ahead].min(initial=math.inf)), float(ranges[behind].min(initial=math.inf))


Forbidden = tuple[bool, tuple[tuple[str, frozenset[Atom]], ...]]


def _hazards(message: RosMessage) -> Forbidden:
    numbers = {int(one.type) for one in message.detections}
    unknown = ("an unknown hazard is near", _MOVING)
    return _BUMP in numbers, tuple(_HAZARDS.get(number, unknown) for number in sorted(numbers))


def _bumpers(message: RosMessage) -> Forbidden:
    ahead, behind = bool(message.bumper & _BUMPER_FORWARD), bool(message.bumper & _BUMPER_BACKWARD)
    forbidden: list[tuple[str, frozenset[Atom]]] = []
    if ahead:
        forbidden.append((_HAZARDS[_BUMP][0], _MOVING - {"backward"}))
    if behind:
        forbidden.append(("its rear bumper is pressed", _MOVING - {"forward"}))
    return ahead or behind, tuple(forbidden)


def _button(message: RosMessage) -> Forbidden:
    return False, (("it is told not to move", _MOVING),) if message.data else ()


def _made_s(clock: StampedClock, message: RosMessage, arrived_s: float) -> float:
    stamp = message.header.stamp
    made_s = clock.made_s(stamp.sec + stamp.nanosec / 1e9, arrived_s)
    if made_s is None:
        raise MessageError("its stamp is not newer than that of the one before")
    return made_s


def _triple(vector: RosMessage) -> Triple:
    return float(vector.x), float(vector.y), float(vector.z)


def _check_finite(what: str, values: tuple[float, ...], most: float) -> None:
    if not all(abs(value) <= most for value in values):  # NaN is not either
        raise MessageError(f"its {what} is not finite, or beyond {most:g}")


def pixels(message: RosMessage) -> NDArray[np.uint8]:
    """Return the picture in a CompressedImage or an Image, (height, width, 3) RGB.

    Raises
    ------
    MessageError
        There is none that we understand.
    """
    try:
        if hasattr(message, "format"):
            return decode_jpeg(message.data.tobytes())
        return rgb_of(message.encoding, message.width, message.height, message.step, message.data)
    except ValueError as error:
        raise MessageError(str(error)) from None
