"""The one table of topics, of which recorder, health, ``smal topic`` and README are made; services in ``table.py``."""

import math
import re
from dataclasses import dataclass
from typing import Final, Literal, get_args

from schemas.action import Action
from schemas.base import ROBOT_ID_PATTERN, SOURCES, Message
from schemas.camera import CameraInfo, CompressedImage, DepthImage, OverheadImage
from schemas.command import Command, CommandApplied
from schemas.episode import Episode
from schemas.heartbeat import Heartbeat, Pulse
from schemas.motion import Imu, Odometry, TrackedPose, TruePose
from schemas.observation import Observation
from schemas.snapshot import Snapshot
from schemas.state import State
from schemas.taught_map import TaughtMap

ROOT: Final = "smal"
#: How long, at least, a sender keeps what is recorded, so that a recorder which was away gets it afterwards.
KEPT_S: Final = 30.0
#: What flows by one link waits for nothing that flows by another: no image stands before a command, and nothing at all
#: before an emergency stop. Whatever is not ordinary is sent at once.
Lane = Literal["ordinary", "urgent", "stop"]
LANES: Final[tuple[Lane, ...]] = get_args(Lane)


@dataclass(frozen=True)
class Topic:
    """One row of the table."""

    name: str  # The key after ``smal/<robot>/``.
    message: type[Message]
    rate_hz: float | None  # Nominal rate while an episode runs; None for events.
    queue: int  # Messages that a receiver keeps; the oldest gives way to the newest.
    recorded: bool  # Whether the recorder writes it.
    lane: Lane = "ordinary"  # Which of a process's links it travels by.
    reliable: bool = False  # Whether the sender waits rather than drops when the network is full.
    sent_by: Lane | None = None  # Link by which it leaves its sender; ``lane`` if not given.

    def key(self, robot: str) -> str:
        """Return the Zenoh key of this topic for one robot (or ``*`` for every robot)."""
        return f"{ROOT}/{robot}/{self.name}"

    @property
    def outgoing(self) -> Lane:
        """Link by which it leaves its sender."""
        return self.sent_by or self.lane

    @property
    def kept(self) -> int:
        """How many messages a sender keeps: half as many again as the nominal rate, or 10 Hz of events, asks for."""
        return math.ceil(1.5 * KEPT_S * (self.rate_hz or 10))

    @property
    def meaning(self) -> str:
        """First line of the message's description."""
        return (self.message.__doc__ or "").strip().splitlines()[0]


JPEG: Final = Topic("camera/jpeg", CompressedImage, 10, 8, True)
CAMERA_INFO: Final = Topic("camera/info", CameraInfo, None, 8, True)
DEPTH: Final = Topic("camera/depth", DepthImage, 10, 1, False)
OVERHEAD: Final = Topic("camera/overhead", OverheadImage, 10, 1, False)
ODOMETRY: Final = Topic("odometry", Odometry, 10, 8, True)
IMU: Final = Topic("imu", Imu, 10, 8, True)
POSE: Final = Topic("pose/truth", TruePose, 10, 8, True)
TRACKED: Final = Topic("pose/tracked", TrackedPose, 10, 8, True)
#: Not recorded: a vector is larger than its image, from which learning computes it again.
OBSERVATION: Final = Topic("observation", Observation, 10, 8, False)
STATE: Final = Topic("state", State, 10, 8, True)
MAP: Final = Topic("map", TaughtMap, None, 8, True)
#: By the service whose instances hand robots on by it; see `services.kit.group`.
SNAPSHOTS: Final = {
    service: Topic(f"snapshot/{service}", Snapshot, 1, 1, False)
    for service in ("recognition", "policy")
}
ACTION: Final = Topic("action", Action, None, 8, True)
COMMANDS: Final = {
    source: Topic(
        f"command/{source}",
        Command,
        rate_hz=None if source == "emergency_stop" else 10,
        queue=8,
        recorded=True,
        lane="stop" if source == "emergency_stop" else "urgent",
    )
    for source in SOURCES
}
APPLIED: Final = Topic("command/applied", CommandApplied, 10, 8, True, lane="urgent")
#: At 20 Hz, so that two may be lost; see `services.robot.gate.OPERATOR_S`. Of several only the newest is answered.
PULSE: Final = Topic("pulse", Pulse, 20, 1, False, lane="urgent")
#: Of an operator as often, since each pulse is answered. It leaves its sender by the link of emergency stops, so that a
#: robot misses an operator without a way to stop it. The robot receives it by another link than stops: a flood of
#: heartbeats must not delay them.
HEARTBEAT: Final = Topic("heartbeat", Heartbeat, 20, 8, False, lane="urgent", sent_by="stop")
EPISODE: Final = Topic("episode", Episode, None, 64, True, reliable=True)

TOPICS: Final[dict[str, Topic]] = {
    topic.name: topic
    for topic in (
        *(JPEG, CAMERA_INFO, DEPTH, OVERHEAD),
        *(ODOMETRY, IMU, POSE, TRACKED),
        *(OBSERVATION, MAP, STATE, ACTION, *SNAPSHOTS.values()),
        *(*COMMANDS.values(), APPLIED, PULSE, HEARTBEAT, EPISODE),
    )
}


def check_robot_id(robot: str) -> str:
    """Return a robot id unchanged, or raise ValueError that names it."""
    if not re.fullmatch(ROBOT_ID_PATTERN, robot):
        raise ValueError(f"robot id {robot!r} does not match {ROBOT_ID_PATTERN}")
    return robot


def topic_of(key: str) -> Topic | None:
    """Return the topic of a Zenoh key, or None where the key is no topic of ours."""
    root, _, rest = key.partition("/")
    robot, _, name = rest.partition("/")
    if root != ROOT or not re.fullmatch(ROBOT_ID_PATTERN, robot):
        return None
    return TOPICS.get(name)


def key_of(message: Message) -> str:
    """Return the Zenoh key that a message belongs on."""
    return TOPICS[message.topic_name].key(message.robot)


def rpc_key(robot: str, service: str, verb: str) -> str:
    """Return the Zenoh key of a service's queryable."""
    return f"{ROOT}/{robot}/rpc/{service}/{verb}"


def echo_key(role: str, process: str, sender: str, receiver: str) -> str:
    """Return the Zenoh key by which a process of a role sends itself signs of life from one lane to another."""
    return f"{ROOT}/@echo/{role}/{process}/{sender}/{receiver}"


def group_key(fleet: str, service: str) -> str:
    """Return the Zenoh key below which the instances of a service are seen; no wildcard matches a part with ``@``."""
    return f"{ROOT}/{fleet}/@group/{service}"
