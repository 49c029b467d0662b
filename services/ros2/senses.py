"""State of a robot's inputs: newest frame, odometry, inertial readings, and forbidden movements."""

import logging
import math
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from threading import Lock
from typing import Final, NamedTuple

import numpy as np

from schemas.base import ATOMS, Atom
from schemas.camera import CompressedImage
from schemas.motion import MAX_SAMPLES
from services.kit.cameras import camera_of_ros
from services.kit.jpeg import decode_jpeg, encode_jpeg
from services.kit.pixels import BitDepth, is_upright, rgb_of
from services.kit.ros_message import LARGEST_BYTES, heading_of
from services.kit.throttle import Throttle
from services.robot.body import ImuReading, Triple
from services.robot.clock import now_s
from services.robot.wheel_track import WheelTrack
from services.ros2 import messages
from services.ros2.clock import LEARN_S, StampedClock
from services.ros2.config import Ros2Config, ScanTopic
from services.ros2.messages import MessageError, Messages, RosMessage
from services.ros2.scanner import ways
from smal.camera import Camera

#: As in `schemas.motion` and `schemas.camera`; far beyond any base.
_MOST_RAD_S = 100.0
_MOST_M_S2 = 1000.0
_MOST_COLUMNS = 4096
_MOST_ROWS = 3072
#: Maximum size of a message: an image for the stack's bus, 130,000 beams, or anything else.
_MOST_BYTES: Final = {
    messages.IMAGE: LARGEST_BYTES,
    messages.COMPRESSED_IMAGE: CompressedImage.max_bytes - 1024,
    messages.LASER_SCAN: 1 << 20,
}
_MOST_OTHER_BYTES: Final = 1 << 16
_MOVING: Final = frozenset(ATOMS) - {"stop"}
Ban = tuple[str, frozenset[Atom]]  # Reason, and the forbidden movements.
# Types of irobot_create_msgs/msg/HazardDetection, by number.
_HAZARDS: Final[dict[int, Ban]] = {
    0: ("the limit of backing up is reached", frozenset({"backward"})),
    1: ("its bumper is pressed", _MOVING - {"backward"}),
    2: ("a cliff is ahead", _MOVING - {"backward"}),
    3: ("its wheels are stalled", _MOVING),
    4: ("a wheel hangs in the air", _MOVING),
    5: ("an obstacle is near its front", frozenset({"forward"})),
}
_UNKNOWN_HAZARD: Final[Ban] = ("an unknown hazard is near", _MOVING)
_BUMP: Final = 1
# Fields of turtlebot3_msgs/msg/SensorState.
_BUMPER_FORWARD = 1
_BUMPER_BACKWARD = 2
_log = logging.getLogger("ros2")


@dataclass(frozen=True, eq=False)
class Frame:
    """Undecoded image (CompressedImage or Image), and its exposure by our clock."""

    message: RosMessage
    captured_s: float


class Heard(NamedTuple):
    """A subscribed topic."""

    type_name: str
    take: Callable[[RosMessage, float], None]  # Takes a message, and when it was made by our clock.
    # Clock of its stamps; None if messages count from their arrival.
    clock: StampedClock | None = None
    silence_s: float | None = None
    """Silence after which the robot is not moved: infinity for topics of changes only, None if
    optional.
    """


class Senses:
    """Stores the newest messages of a robot; thread-safe."""

    def __init__(self, config: Ros2Config, clock: Callable[[], float] = now_s) -> None:
        self._config = config
        self._messages = Messages(config.distribution)
        self._clock = clock
        self._lock = Lock()
        self._heard_s: dict[str, float] = {}
        self._asked_s = -math.inf  # Time at which the newest received echo was sent.
        self._imu: deque[ImuReading] = deque(maxlen=MAX_SAMPLES)
        self.camera: Camera | None = None
        self._forbidden: dict[str, tuple[Ban, ...]] = {}
        self._unseen: dict[Atom, str] = {}
        self._complaints = Throttle()
        self.frame: Frame | None = None
        silence_s = 0.0 if config.odometry is None else config.odometry.silence_s
        self.track = WheelTrack(config.speed_m_s, config.turn_rate_rad_s, silence_s)
        self.touched = False  # Whether the bumper was pressed since this was last reset.
        # Messages that were invalid or not newer than the one before, by topic.
        self.refused: Counter[str] = Counter()
        self.camera_clock = StampedClock()
        self.inputs = self._plan(config)

    def _plan(self, config: Ros2Config) -> dict[str, Heard]:
        full = config.full
        inputs = {
            full(config.camera.topic): Heard(str(config.camera.type), self._see, self.camera_clock)
        }
        if config.camera.info is not None:
            inputs[full(config.camera.info)] = Heard(messages.CAMERA_INFO, self._calibrate)
        if config.imu is not None:
            inputs[full(config.imu.topic)] = Heard(messages.IMU, self._feel, StampedClock())
        if config.odometry is not None:
            wheels = Heard(messages.ODOMETRY, self._roll, StampedClock(), config.odometry.silence_s)
            inputs[full(config.odometry.topic)] = wheels
        if config.scan is not None:
            topic = full(config.scan.topic)
            take = partial(self._scan, topic, config.scan)
            inputs[topic] = Heard(messages.LASER_SCAN, take, StampedClock(), config.scan.silence_s)
        for stop in config.stops:
            # Topics of changes are as old as their arrival, and a Bool has no stamp.
            stamped = stop.silence_s is not None and stop.type != messages.BOOL
            take = partial(self._stop, full(stop.topic), str(stop.type))
            clock = StampedClock() if stamped else None
            silence_s = math.inf if stop.silence_s is None else stop.silence_s
            inputs[full(stop.topic)] = Heard(str(stop.type), take, clock, silence_s)
        return inputs

    # -- received ----------------------------------------------------------------------------------

    def echoed(self, asked_s: float) -> None:
        """Store the sending time, by our clock, of an echo that the robot's router returned.

        The link preserves the order: a later message left the router later.
        """
        self._asked_s = asked_s

    def take(self, topic: str, payload: bytes) -> None:
        """Take the bytes of a message; never raises an error."""
        arrived_s = self._clock()
        link_s = arrived_s - self._asked_s
        heard = self.inputs[topic]
        try:
            most = _MOST_BYTES.get(heard.type_name, _MOST_OTHER_BYTES)
            if len(payload) > most:
                raise MessageError(f"too large ({len(payload)} bytes > maximum {most})")
            message = self._messages.read(heard.type_name, payload)
            with self._lock:
                made_s: float | None = arrived_s
                if heard.clock is not None:
                    stamp = message.header.stamp
                    made_s = heard.clock.made_s(stamp.sec + stamp.nanosec / 1e9, arrived_s, link_s)
                if made_s is None:
                    raise MessageError("its stamp is not newer than the previous stamp")
                heard.take(message, made_s)
                self._heard_s[topic] = made_s
        except MessageError as error:
            self.refuse(topic, str(error))

    def changes(self) -> list[str]:
        """Return the topics that publish only changes."""
        return [topic for topic, heard in self.inputs.items() if heard.silence_s == math.inf]

    def forget(self, topic: str) -> None:
        """Forget that a topic was received; its prohibitions stay until the next message."""
        self._heard_s.pop(topic, None)

    def refuse(self, topic: str, why: str) -> None:
        """Count a refused message."""
        self.refused[topic] += 1
        if self._complaints.due():
            _log.warning("%s: message refused (%d in total): %s", topic, self.refused[topic], why)

    def _see(self, message: RosMessage, made_s: float) -> None:
        self.frame = Frame(message, made_s - self._config.camera.latency_s)

    def _calibrate(self, message: RosMessage, _at_s: float) -> None:
        try:
            self.camera = camera_of_ros(message)
        except ValueError as error:
            raise MessageError(str(error)) from None

    def _roll(self, message: RosMessage, made_s: float) -> None:
        pose = message.pose.pose
        heading_rad = heading_of(pose.orientation)
        _check_finite("pose", (pose.position.x, pose.position.y, heading_rad), 1e6)
        self.track.add(made_s, pose.position.x, pose.position.y, heading_rad)

    def _feel(self, message: RosMessage, made_s: float) -> None:
        turn = _triple(message.angular_velocity)
        push = _triple(message.linear_acceleration)
        _check_finite("angular velocity", turn, _MOST_RAD_S)
        _check_finite("acceleration", push, _MOST_M_S2)
        self._imu.append(ImuReading(made_s, turn, push))

    def _scan(self, topic: str, scan: ScanTopic, message: RosMessage, _at_s: float) -> None:
        places: tuple[tuple[Atom, str, bool], ...] = (
            ("forward", "ahead", True),
            ("backward", "behind", scan.behind),
        )
        try:
            told = ways(message, scan)
        except MessageError as error:
            # An unreadable scan invalidates the previous one.
            self._unseen = {atom: f"{topic}: {error}" for atom, _, must in places if must}
            raise
        unclear = (
            ""
            if scan.zero_is_free or np.all(message.ranges)
            else "; if 0 means free, set zero_is_free"
        )
        forbidden: list[Ban] = []
        unseen: dict[Atom, str] = {}
        for (atom, where, must), way in zip(places, told, strict=True):
            if way.nearest_m < math.inf:
                forbidden.append((f"obstacle {way.nearest_m:.2f} m {where}", frozenset({atom})))
            if must and not way.seen:
                unseen[atom] = (
                    f"{topic}: {math.degrees(way.unseen_rad):.0f} degrees {where} are unknown{unclear}"
                )
        self._forbidden[topic] = tuple(forbidden)
        self._unseen = unseen

    def _stop(self, topic: str, type_name: str, message: RosMessage, _at_s: float) -> None:
        touched, self._forbidden[topic] = _STOPS[type_name](message)
        self.touched |= touched

    # -- evaluation --------------------------------------------------------------------------------

    def forbids(self, atom: Atom) -> str | None:
        """Return why the base must not make a movement, or None."""
        for topic, forbidden in list(self._forbidden.items()):
            for why, atoms in forbidden:
                if atom in atoms:
                    return f"{why} ({topic})"
        return None

    def silent(self, *atoms: Atom) -> str | None:
        """Return which silent topic or unknown way prevents movements, or None."""
        now = self._clock()
        for topic, heard in self.inputs.items():
            if heard.silence_s is None:
                continue
            heard_s = self._heard_s.get(topic)
            if heard_s is None:
                return f"no message received from {topic}"
            if now - heard_s > heard.silence_s:
                return f"no message from {topic} for {now - heard_s:.1f} s"
        return self.learning() or next(
            (self._unseen[atom] for atom in atoms if atom in self._unseen), None
        )

    def learning(self) -> str | None:
        """Return which required clock is still unknown, or None."""
        if self._asked_s == -math.inf:
            return (
                "the age of messages is unknown: the robot's router returns no echo; "
                "allow smal/echo/** there"
            )
        for topic, heard in self.inputs.items():
            must = heard.clock is self.camera_clock or heard.silence_s is not None
            if must and heard.clock is not None and not heard.clock.known:
                return f"the clock of {topic} is being learned; wait {LEARN_S:g} s"
        return None

    def imu_since_last(self) -> list[ImuReading]:
        """Return the inertial readings since the last call, by our clock."""
        with self._lock:
            readings = list(self._imu)
            self._imu.clear()
        return readings


# Evaluation of a stop topic: whether a bumper was touched, and the prohibitions.
Said = tuple[bool, tuple[Ban, ...]]


def _hazards(message: RosMessage) -> Said:
    numbers = sorted({int(one.type) for one in message.detections})
    return _BUMP in numbers, tuple(_HAZARDS.get(number, _UNKNOWN_HAZARD) for number in numbers)


def _bumpers(message: RosMessage) -> Said:
    ahead = message.bumper & _BUMPER_FORWARD
    others = message.bumper & ~_BUMPER_FORWARD
    forbidden = [_HAZARDS[_BUMP]] if ahead else []
    if others == _BUMPER_BACKWARD:
        forbidden.append(("its rear bumper is pressed", _MOVING - {"forward"}))
    elif others:
        forbidden.append(("an unknown bumper is pressed", _MOVING))
    return bool(message.bumper), tuple(forbidden)


def _button(message: RosMessage) -> Said:
    return False, (("its stop topic is true", _MOVING),) if message.data else ()


_STOPS: Final[dict[str, Callable[[RosMessage], Said]]] = {
    messages.HAZARDS: _hazards, messages.SENSOR_STATE: _bumpers, messages.BOOL: _button
}  # fmt: skip


def _triple(vector: RosMessage) -> Triple:
    return float(vector.x), float(vector.y), float(vector.z)


def _check_finite(what: str, values: tuple[float, ...], most: float) -> None:
    if not all(abs(value) <= most for value in values):  # False for NaN.
        raise MessageError(f"invalid {what}: must be finite and at most {most:g}")


def picture(message: RosMessage, depth: BitDepth | None = None) -> bytes:
    """Return a message's image as JPEG; MessageError if it is invalid."""
    try:
        if hasattr(message, "format"):
            # Published unchanged if it stands upright; decoded to check that it is complete.
            jpeg = message.data.tobytes()
            image = decode_jpeg(jpeg)
            jpeg = jpeg if is_upright(jpeg) else b""
        else:
            image = rgb_of(message, depth)
            jpeg = b""
        height, width, _ = image.shape
        if width > _MOST_COLUMNS or height > _MOST_ROWS:
            raise MessageError(
                f"too large ({width}x{height} pixels > maximum {_MOST_COLUMNS}x{_MOST_ROWS})"
            )
        return jpeg or encode_jpeg(image)
    except ValueError as error:
        raise MessageError(str(error)) from None
