"""Requests and replies of the queryables ``rpc/<service>/<verb>``.

They are JSON, so that curl can read them.
"""

import math
import re
from typing import Annotated, Final, Literal

from pydantic import AfterValidator, Field

from schemas.base import MAX_TICK, EpisodeId, SessionId, Strict
from schemas.episode import Box, GoalName, Purpose, Said, Victim

Mode = Literal["lockstep", "realtime"]
# About the world's start, the same turned round, anywhere beside the way from there to the victim, or
# where the robot stands.
Start = Literal["start", "turned", "anywhere", "here"]
#: Localisation by a filter over the map of views, or by the paper's Eq. 7 to 9 with a decision every
#: l frames.
Scheme = Literal["filter", "paper"]
#: Sources that can drive; an emergency stop only stops the robot.
Driver = Literal["teleop", "expert", "policy"]


#: Part of a path below the root of a service. It excludes hidden names (a leading dot, with it ``.``
#: and ``..``), separators and control characters.
_PART: Final = r"[^./\\\x00-\x1f\x7f-\x9f][^/\\\x00-\x1f\x7f-\x9f]*"
_NAME: Final = re.compile(rf"{_PART}(/{_PART})*")
_MAX_NAME: Final = 1023  # Maximum length in characters: at 4 bytes each, the limit of Linux.


def _is_below(name: str) -> str:
    if name and _NAME.fullmatch(name) is None:
        raise ValueError(
            "must be a relative path below the root of the service; no part may begin with a dot"
        )
    return name


#: Folder below the root of a service; empty for the root itself.
FolderName = Annotated[str, Field(max_length=_MAX_NAME), AfterValidator(_is_below)]
#: File below the root of a service.
FileName = Annotated[str, Field(min_length=1, max_length=_MAX_NAME), AfterValidator(_is_below)]

# Name that a person gives to an episode.
EpisodeName = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,31}$")]
#: Maximum bytes of a world's name: a file name has 255, and its suffix and temporary name need some.
_MAX_WORLD_NAME: Final = 200


def _fits(name: str) -> str:
    if len(name.encode()) > _MAX_WORLD_NAME:
        raise ValueError(f"too large ({len(name.encode())} bytes > maximum {_MAX_WORLD_NAME})")
    return name


#: Name of a world, or of a variation of its light and objects.
WorldName = Annotated[str, Field(pattern=r"^\w[\w ().-]{0,63}$"), AfterValidator(_fits)]

# Maximum frames of an episode: more than a day.
MAX_TICKS: Final = 1_000_000

Metres = Annotated[float, Field(ge=-1e5, le=1e5)]
#: From east, anticlockwise.
HeadingRad = Annotated[float, Field(ge=-math.pi, le=math.pi)]
Point = tuple[Metres, Metres]  # Position in the world, in the coordinates of the robot's pose.


class Nothing(Strict):
    """Request without arguments, or reply without a result."""


class Failure(Strict):
    """Reply to a request that failed."""

    error: str


class Status(Strict):
    """State of a service; the reply to every service's ``status``."""

    service: str
    state: Literal["starting", "ready", "stopping"]  # Whether the service takes work.
    pid: int
    connected: bool  # Whether every lane has a router that echoes.
    silent: tuple[str, ...] = ()  # Lanes without a router, or without its echo.
    uptime_s: float  # Seconds since the start.
    idle_s: float  # Seconds since the last piece of work was finished.
    # Seconds that the current piece of work has taken; 0 while idle.
    busy_s: float
    oldest_s: float  # Age of the oldest waiting message or request, seconds.
    waiting: dict[str, int]  # Number of waiting messages and requests, by topic.
    received: dict[str, int]  # Number of messages received, by topic.
    published: dict[str, int]  # Number of messages published, by topic.
    # Number of messages replaced by newer messages before they were handled, by topic.
    dropped: dict[str, int]
    bad: dict[str, int]  # Number of malformed messages and requests, by topic.
    failed: int  # Number of requests and messages whose handling failed; each is logged.
    detail: dict[str, str | int | float | bool | None]  # Details of the service.


class ArmRequest(Strict):
    """Release a latched stop, so that the robot can be moved again (robot).

    The robot stays where it is. A driver continues only after ``resume`` or a new episode.
    """

    #: Number of the stop, from the status or ``command/applied``; refused if another stop was
    #: latched since.
    stop: Annotated[int, Field(ge=1, lt=2**63)]
    session: SessionId = ""  # Caller; while an operator is active, only theirs is accepted.


class ResetRequest(Strict):
    """Begin an episode (robot).

    The robot refuses while a stop is latched or another session's episode runs.
    """

    # Session that owns the episode.
    session: SessionId = ""
    #: Prefix of the episode's id, and thus of its recording; purpose and seed by default.
    name: EpisodeName | None = None
    #: World from now on, listed in the status; unchanged by default (simulated robots).
    world: WorldName | None = None
    #: Conditions in the world, listed in the status; unchanged by default (simulated robots).
    variation: WorldName | None = None
    seed: Annotated[int, Field(ge=0, lt=2**63)]  # Seed of start pose and actuation noise.
    purpose: Purpose = "run"  # Set of starts to draw from.
    driver: Driver = "policy"
    #: Start of a run; turned: with the back to the way; anywhere: up to 1.5 m beside the way (less
    #: indoors), turned by up to 40 degrees; here: where a simulated robot stands.
    start: Start = "start"
    #: Frame at which the robot is kidnapped: moved to another such place while its wheels stand.
    kidnap_tick: Annotated[int | None, Field(ge=1, le=MAX_TICKS)] = None
    # Variant of the victim (simulated robots); moved: up to 3 m from its place, less indoors.
    victim: Victim = "there"
    #: Whether a run continues until the robot reports a result; otherwise it ends at the goal.
    until_said: bool = False
    #: Number of untaught obstacles on and beside the way (simulated robots).
    obstacles: Annotated[int, Field(ge=0, le=50)] = 0
    # Number of people who walk near the way (simulated robots).
    people: Annotated[int, Field(ge=0, le=50)] = 0
    blocked: bool = False  # Whether an obstacle closes the way (simulated robots).
    goal: GoalName = "victim"  # Place that the drive leads to, for learning.
    mode: Mode = "lockstep"  # Whether time waits for commands.
    #: Timeout of the episode in frames; null if a person ends it.
    max_ticks: Annotated[int | None, Field(ge=1, le=MAX_TICKS)] = 3000


class ResetReply(Strict):
    """The episode that began."""

    episode: EpisodeId
    world: str  # Name of the world; for a real robot without a world, name of its body.
    speed_m_s: Annotated[float, Field(gt=0)]
    car: bool = False  # Whether the robot cannot turn on the spot.
    #: Way points from the start to the victim, metres, for the scripted expert; empty if unknown.
    route: tuple[tuple[float, float], ...] = ()
    # Distance at which a visible victim counts as found.
    found_m: Annotated[float, Field(gt=0)] | None = None
    #: Position of the victim, metres; None if unknown or absent.
    victim: tuple[float, float] | None = None
    #: Outlines of the untaught obstacles on and beside the way, metres, if known.
    things: Annotated[
        tuple[Annotated[tuple[Point, ...], Field(max_length=100)], ...], Field(max_length=100)
    ] = ()


class LookReply(Strict):
    """View of the robot's camera between two episodes."""

    #: Small JPEG; None while an episode publishes frames, and if the camera has no image.
    picture: bytes | None = None
    #: Ground truth between two episodes (simulated robots): metres and radians.
    pose: tuple[Metres, Metres, HeadingRad] | None = None


class CarryRequest(Strict):
    """Move a simulated robot elsewhere while its wheels stand (robot): it is kidnapped.

    Refused during a drive, which would teach a wrong way, and if the place is not free.
    """

    x_m: Metres
    y_m: Metres
    heading_rad: HeadingRad
    session: SessionId = ""  # Caller; while an operator is active, only theirs is accepted.


class TaskRequest(Strict):
    """Choose start and goal in the world of a simulated robot (robot).

    They hold until the robot's process ends. Refused during an episode, and without a free way.
    """

    start: Point
    goal: Point
    session: SessionId = ""  # Caller; while an operator is active, only theirs is accepted.


#: Kinds of a ground plan's shapes, from the lowest.
PlanKind = Literal["ground", "water", "street", "solid"]
MOST_SHAPES: Final = 3000  # Maximum number of a ground plan's shapes.
MOST_POINTS: Final = 1000  # Maximum number of a shape's points.


class PlanShape(Strict):
    """Shape of a ground plan: a filled outline, or a line."""

    kind: PlanKind
    points: Annotated[tuple[Point, ...], Field(max_length=MOST_POINTS)]
    filled: bool


class PlanReply(Strict):
    """Ground plan of a simulated robot's world, in the coordinates of its poses."""

    world: str
    start: Point
    victim: Point
    #: Free way from the start to the victim; empty without one.
    route: Annotated[tuple[Point, ...], Field(max_length=MOST_POINTS)] = ()
    shapes: Annotated[tuple[PlanShape, ...], Field(max_length=MOST_SHAPES)]


class CancelRequest(Strict):
    """Cancel the ``reset`` that is opening its world (robot); its caller receives the reason."""

    # Caller: the session that requested the episode, or the robot's operator.
    session: SessionId = ""


class EndRequest(Strict):
    """End the running episode (robot)."""

    # Episode to end; refused if another episode runs.
    episode: EpisodeId
    #: Whether the operator confirms that the goal is reached; otherwise the robot's task judges.
    found: bool = False
    # Box of the goal in the last frame; ignored unless found.
    box: Box | None = None
    # Report of the robot, which the task judges; None without a report.
    said: Said | None = None
    # Caller; while an operator is active, only they can confirm that the goal is found.
    session: SessionId = ""


class ResumeRequest(Strict):
    """Return control to the driver after a person took over or a stop was released (robot)."""

    # Episode to continue; refused if another episode has begun.
    episode: EpisodeId
    #: Newest frame that the person had received; refused if they have commanded since.
    tick: Annotated[int, Field(ge=0, le=MAX_TICK)]
    session: SessionId = ""  # Caller; while an operator is active, only theirs is accepted.


class LoadRequest(Strict):
    """Load a model (recognition, policy)."""

    # Path of the model file below the service's root, without a part that begins with a dot.
    model: FileName
    #: Scheme that the model must have been learned for; any by default.
    scheme: Scheme | None = None
    # Goal of the run; optional if the model has a single goal.
    goal: GoalName | None = None
    #: Frames between two decisions in the paper's scheme; the model's sequence length by default.
    stride: Annotated[int | None, Field(ge=1, le=1000)] = None


class LoadReply(Strict):
    """The model that was loaded."""

    scheme: Scheme
    keyframes: int = 0  # Size of its map of views; 0 in the paper's scheme.
    states: int = 0  # Number of learned states; 0 except in the paper's scheme.
    stride: int  # Frames between two decisions.


class RecordRequest(Strict):
    """Record every episode from now on (recorder)."""

    #: Folder of the recordings, one file per episode: path below the recorder's root, empty for the
    #: root itself.
    folder: FolderName


class RecordReply(Strict):
    """Finished recordings (recorder ``stop``, ``flush``)."""

    #: Names of the recordings finished since ``start``, in the folder that it named; oldest first.
    files: tuple[str, ...]
    dropped: int  # Number of messages that could not be recorded.
