"""Table of topics, the source of recorder, health, ``smal topic`` and README.

For the services see `services.table`.
"""

import math
import re
from dataclasses import dataclass
from typing import Final, Literal, get_args

from schemas.action import Action
from schemas.base import ROBOT_ID_PATTERN, SOURCES, TICK_S, Message
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
#: Minimum time that a sender keeps recorded messages, so that a recorder can fetch them after an
#: outage.
KEPT_S: Final = 30.0
_FRAME_HZ: Final = round(1.0 / TICK_S)
#: Messages of one lane never wait for those of another: no image delays a command, and emergency
#: stops have a lane of their own. Lanes other than "ordinary" send at once.
Lane = Literal["ordinary", "urgent", "stop"]
LANES: Final[tuple[Lane, ...]] = get_args(Lane)


@dataclass(frozen=True)
class Topic:
    """A topic: its message, its rate and how it travels."""

    # Key after ``smal/<robot>/``.
    name: str
    message: type[Message]
    rate_hz: float | None  # Nominal rate while an episode runs; None for events.
    queue: int  # Length of a receiver's queue; the newest message replaces the oldest.
    recorded: bool  # Whether the recorder writes it.
    lane: Lane = "ordinary"  # Link of a process that carries it.
    reliable: bool = False  # Whether the sender waits rather than drops when the network is full.
    sent_by: Lane | None = None  # Link by which it leaves its sender; ``lane`` by default.

    def key(self, robot: str) -> str:
        """Return the Zenoh key of this topic for one robot (or ``*`` for every robot)."""
        return f"{ROOT}/{robot}/{self.name}"

    @property
    def outgoing(self) -> Lane:
        """Link by which it leaves its sender."""
        return self.sent_by or self.lane

    @property
    def kept(self) -> int:
        """Number of messages that a sender keeps: 1.5 times the nominal rate (events: of frames)."""
        return math.ceil(1.5 * KEPT_S * (self.rate_hz or _FRAME_HZ))

    @property
    def meaning(self) -> str:
        """First line of the message's description."""
        return (self.message.__doc__ or "").strip().splitlines()[0]


JPEG: Final = Topic("camera/jpeg", CompressedImage, _FRAME_HZ, 8, True)
CAMERA_INFO: Final = Topic("camera/info", CameraInfo, None, 8, True)
DEPTH: Final = Topic("camera/depth", DepthImage, _FRAME_HZ, 1, False)
OVERHEAD: Final = Topic("camera/overhead", OverheadImage, _FRAME_HZ, 1, False)
ODOMETRY: Final = Topic("odometry", Odometry, _FRAME_HZ, 8, True)
IMU: Final = Topic("imu", Imu, _FRAME_HZ, 8, True)
POSE: Final = Topic("pose/truth", TruePose, _FRAME_HZ, 8, True)
TRACKED: Final = Topic("pose/tracked", TrackedPose, _FRAME_HZ, 8, True)
#: Not recorded: a vector is larger than its image, from which learning computes it again.
OBSERVATION: Final = Topic("observation", Observation, _FRAME_HZ, 8, False)
STATE: Final = Topic("state", State, _FRAME_HZ, 8, True)
MAP: Final = Topic("map", TaughtMap, None, 8, True)
#: Snapshots by which instances of a service pass on robots; see `services.kit.group`.
SNAPSHOTS: Final = {
    service: Topic(f"snapshot/{service}", Snapshot, 1, 1, False)
    for service in ("recognition", "policy")
}
ACTION: Final = Topic("action", Action, None, 8, True)
COMMANDS: Final = {
    source: Topic(
        f"command/{source}",
        Command,
        rate_hz=None if source == "emergency_stop" else _FRAME_HZ,
        queue=8,
        recorded=True,
        lane="stop" if source == "emergency_stop" else "urgent",
    )
    for source in SOURCES
}
APPLIED: Final = Topic("command/applied", CommandApplied, _FRAME_HZ, 8, True, lane="urgent")
#: 20 Hz, so that two can be lost; see `services.robot.clock.ABSENT_S`. Operators answer the newest.
PULSE: Final = Topic("pulse", Pulse, 20, 1, False, lane="urgent")
#: One heartbeat answers each pulse. It leaves its sender by the link of emergency stops: a robot
#: must miss an operator who cannot stop it. The robot receives it by another link than stops, which
#: a flood of heartbeats must not delay.
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
    """Return a valid robot id unchanged; raise ValueError otherwise."""
    if not re.fullmatch(ROBOT_ID_PATTERN, robot):
        raise ValueError(f"invalid robot id {robot!r}: must match {ROBOT_ID_PATTERN}")
    return robot


def topic_of(key: str) -> Topic | None:
    """Return the topic of a Zenoh key, or None for any other key."""
    root, _, rest = key.partition("/")
    robot, _, name = rest.partition("/")
    if root != ROOT or not re.fullmatch(ROBOT_ID_PATTERN, robot):
        return None
    return TOPICS.get(name)


def key_of(message: Message) -> str:
    """Return the Zenoh key of a message."""
    return TOPICS[message.topic_name].key(message.robot)


def rpc_key(robot: str, service: str, verb: str) -> str:
    """Return the Zenoh key of a service's queryable."""
    return f"{ROOT}/{robot}/rpc/{service}/{verb}"


def echo_key(role: str, process: str, sender: str, receiver: str) -> str:
    """Return the Zenoh key of the echo that a process sends from one lane to another."""
    return f"{ROOT}/@echo/{role}/{process}/{sender}/{receiver}"


def group_key(fleet: str, service: str) -> str:
    """Return the key prefix of a service's instances; wildcards do not match ``@`` parts."""
    return f"{ROOT}/{fleet}/@group/{service}"
