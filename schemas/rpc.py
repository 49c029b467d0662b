"""Requests and replies of the services' queryables ``rpc/<service>/<verb>``; JSON, so that curl reads them too."""

import re
from typing import Annotated, Final, Literal

from pydantic import AfterValidator, Field

from schemas.base import MAX_TICK, EpisodeId, SessionId, Strict
from schemas.episode import Box, GoalName, Purpose, Said, Victim

Mode = Literal["lockstep", "realtime"]
Start = Literal[
    "start", "anywhere"
]  # About the world's start, or anywhere beside the way from there to the victim.
#: Knowing where it is by a filter over the map of views; or by the paper's Eq. 7 to 9, deciding every l frames.
Scheme = Literal["filter", "paper"]
#: The sources that can drive; an emergency stop only ever makes the robot stand.
Driver = Literal["teleop", "expert", "policy"]


#: Part of a path below the root of a service: it hides nothing (leading dot, and with it ``.`` and ``..``), separates
#: nothing, and moves no log or terminal.
_PART: Final = r"[^./\\\x00-\x1f\x7f-\x9f][^/\\\x00-\x1f\x7f-\x9f]*"
_NAME: Final = re.compile(rf"{_PART}(/{_PART})*")
_MAX_NAME: Final = 1023  # Most characters of it: at 4 bytes each, what Linux takes.


def _is_below(name: str) -> str:
    if name and _NAME.fullmatch(name) is None:
        raise ValueError(
            "must be a path below the root of the service, relative, and no part may begin with a dot"
        )
    return name


#: A folder below the root of a service; empty for the root itself.
FolderName = Annotated[str, Field(max_length=_MAX_NAME), AfterValidator(_is_below)]
#: A file below the root of a service.
FileName = Annotated[str, Field(min_length=1, max_length=_MAX_NAME), AfterValidator(_is_below)]

EpisodeName = Annotated[
    str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,31}$")
]  # What a person calls an episode.
#: Most bytes of a world's name: of a file's 255 some are for its ending, and for what it is called while it is written.
_MAX_WORLD_NAME: Final = 200


def _fits(name: str) -> str:
    if len(name.encode()) > _MAX_WORLD_NAME:
        raise ValueError(f"must have at most {_MAX_WORLD_NAME} bytes")
    return name


#: Name of a world, or of a variation of its light and things.
WorldName = Annotated[str, Field(pattern=r"^\w[\w ().-]{0,63}$"), AfterValidator(_fits)]

MAX_TICKS: Final = 1_000_000  # Most frames of an episode: a day and more.

_Metres = Annotated[float, Field(ge=-1e5, le=1e5)]
_Point = tuple[_Metres, _Metres]  # Where something is in the world, as a robot's pose is told.


class Nothing(Strict):
    """A request without arguments, or a reply that only says that the work is done."""


class Failure(Strict):
    """A reply that says in one line why the request was not carried out."""

    error: str  # The reason.


class Status(Strict):
    """How a service is; the reply to every service's ``status``."""

    service: str  # Name of the service.
    state: Literal["starting", "ready", "stopping"]  # Whether it takes work.
    pid: int  # Process number.
    connected: bool  # Whether it has a router, which echoes by every lane.
    silent: tuple[str, ...] = ()  # Lanes without a router, or by which the router does not echo.
    uptime_s: float  # Seconds since it started.
    idle_s: float  # Seconds since it last finished a piece of work.
    busy_s: (
        float  # Seconds that the piece of work at hand has taken so far; 0 while it waits for some.
    )
    oldest_s: float  # Seconds that the oldest message or request has waited for its turn.
    waiting: dict[str, int]  # Messages and requests that wait for their turn, by topic.
    received: dict[str, int]  # Messages taken, by topic.
    published: dict[str, int]  # Messages sent, by topic.
    dropped: dict[str, int]  # Messages replaced by newer ones before they were taken, by topic.
    bad: dict[str, int]  # Messages and requests refused as malformed, by topic.
    failed: int  # Requests and messages whose handling failed; each is in the log.
    detail: dict[str, str | int | float | bool | None]  # What else the service tells of itself.


class ArmRequest(Strict):
    """Release a latched stop, so that the robot may be moved again (robot).

    Nothing moves yet: where a driver drove before, it goes on when it is told to, by ``resume`` or a new episode.
    """

    #: Number of the stop, as status and ``command/applied`` tell it; refused when another one is latched meanwhile.
    stop: Annotated[int, Field(ge=1, lt=2**63)]
    session: SessionId = ""  # Who asks; while an operator is heard, only theirs may.


class ResetRequest(Strict):
    """Begin an episode (robot); refused while a stop is latched, and while another session's episode runs."""

    session: SessionId = ""  # Whose episode it will be.
    #: What its id begins with, and so its recording's name; purpose and seed if not given.
    name: EpisodeName | None = None
    #: World to be in from now on, one of those that the status tells; the same if not given (simulated robots).
    world: WorldName | None = None
    #: Conditions there, one of those that the status tells; the same if not given (simulated robots).
    variation: WorldName | None = None
    seed: Annotated[int, Field(ge=0, lt=2**63)]  # Seed of start pose and actuation noise.
    purpose: Purpose = "run"  # Which starts to draw from.
    driver: Driver = "policy"  # Who drives.
    #: Where a run begins; anywhere: up to 1.5 m beside the way (less indoors), turned by up to 40 degrees.
    start: Start = "start"
    #: Frame at which the robot is carried to another such place, without its wheels turning.
    kidnap_tick: Annotated[int | None, Field(ge=1, le=MAX_TICKS)] = None
    victim: Victim = "there"  # How the victim lies (simulated robots); moved: up to 3 m from its place, less indoors.
    #: Whether a run goes on until the robot says something; else it ends where the goal is reached.
    until_said: bool = False
    #: How many things stand on and beside the way, which did not when it was taught (simulated robots).
    obstacles: Annotated[int, Field(ge=0, le=50)] = 0
    people: Annotated[int, Field(ge=0, le=50)] = (
        0  # How many people walk about the way (simulated robots).
    )
    blocked: bool = False  # Whether something closes the way (simulated robots).
    goal: GoalName = "victim"  # Where the drive leads, for those who learn from it.
    mode: Mode = "lockstep"  # Whether time waits for commands.
    #: Frames after which the episode times out; null where somebody ends it, as a person who drives does.
    max_ticks: Annotated[int | None, Field(ge=1, le=MAX_TICKS)] = 3000


class ResetReply(Strict):
    """The episode that began."""

    episode: EpisodeId  # Its id.
    world: str  # Name of the world; of a real robot's body where there is none.
    speed_m_s: Annotated[float, Field(gt=0)]  # The robot's nominal speed.
    car: bool = False  # Whether it cannot turn on the spot.
    #: Way points from the start to the victim, metres, for the scripted expert; none where the way is not known.
    route: tuple[tuple[float, float], ...] = ()
    found_m: Annotated[float, Field(gt=0)] | None = (
        None  # How near the victim counts as found, if it is seen.
    )
    #: Where the victim lies, metres; none where that is not known, or nowhere.
    victim: tuple[float, float] | None = None
    #: Outlines of what stands on and beside the way anew, metres, where that is known.
    things: Annotated[
        tuple[Annotated[tuple[_Point, ...], Field(max_length=100)], ...], Field(max_length=100)
    ] = ()


class LookReply(Strict):
    """What the robot's camera sees between two episodes."""

    #: A small JPEG; none while an episode runs, whose frames are told, and where the camera shows nothing.
    picture: bytes | None = None


class CancelRequest(Strict):
    """Begin no episode after all, while ``reset`` opens its world (robot); its caller is told who has cancelled."""

    session: SessionId = ""  # Who asks: who has asked for the episode, or the robot's operator.


class EndRequest(Strict):
    """End the running episode (robot)."""

    episode: EpisodeId  # Which; refused when another one runs.
    #: Whether the operator says that the goal is reached; otherwise the robot's task says whether it is.
    found: bool = False
    box: Box | None = (
        None  # Where they see it in the last frame; of no account unless they have found it.
    )
    said: Said | None = (
        None  # What the robot says, whom the task judges; None where it has said nothing.
    )
    session: SessionId = (
        ""  # Who asks; while an operator is heard, only they say that something was found.
    )


class ResumeRequest(Strict):
    """Let the driver go on, from whom a person has taken over, or whom a stop has stopped (robot)."""

    episode: EpisodeId  # Which; refused when another one has begun.
    #: The newest frame that the person had heard of; refused when they have commanded since.
    tick: Annotated[int, Field(ge=0, le=MAX_TICK)]
    session: SessionId = ""  # Who asks; while an operator is heard, only theirs may.


class LoadRequest(Strict):
    """Load a model (recognition, policy)."""

    model: FileName  # The model file: its path below the service's root, without a part that begins with a dot.
    #: For which scheme it must have been learned, which is the one that it is used by; any if not given.
    scheme: Scheme | None = None
    goal: GoalName | None = (
        None  # Where to go; may be left out where all that was learned from leads to one goal.
    )
    #: Frames from one decision to the next in the paper's scheme; the model's sequence length if not given.
    stride: Annotated[int | None, Field(ge=1, le=1000)] = None


class LoadReply(Strict):
    """The model that was loaded."""

    scheme: Scheme  # For which it was learned, and how the service works with it.
    keyframes: int = 0  # Of its map of views; 0 in the paper's scheme.
    states: int = 0  # Learned states; 0 but in the paper's scheme.
    stride: int  # Frames from one decision to the next.


class RecordRequest(Strict):
    """Record every episode from now on (recorder)."""

    #: Folder for the recordings, one file an episode: its path below the recorder's root; empty for the root itself.
    folder: FolderName


class RecordReply(Strict):
    """What was recorded (recorder ``stop``, ``flush``)."""

    #: Names of the finished recordings since ``start``, in the folder that it named; oldest first.
    files: tuple[str, ...]
    dropped: int  # Messages that could not be recorded.
