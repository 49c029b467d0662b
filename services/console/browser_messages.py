"""What a browser may say: every message is one of these, or the connection ends."""

from typing import Annotated, Final, Literal

from pydantic import Field, TypeAdapter

from schemas.base import Strict
from schemas.command import Share
from schemas.episode import Box, GoalName, Victim
from schemas.rpc import EpisodeName, FileName, Scheme, Start, WorldName

LATE: Final = "that came too late: the connection is slow, or was away; press again"  # What is said of what came late.


class SeenRequest(Strict):
    """A watcher has taken what was sent, and may be sent more."""

    do: Literal["seen"]


class StopRequest(Strict):
    """Emergency stop; anybody's to say."""

    do: Literal["stop"]


class Hold(Strict):
    """The answer to a beat, which it names: the person is there, and holds a velocity, by keys or a stick, or none."""

    do: Literal["hold"]
    beat: Annotated[int, Field(ge=0)]
    held: tuple[Share, Share] | None  # Linear and angular.


class Leave(Strict):
    """The person stands up; they are not missed."""

    do: Literal["leave"]


class Asked(Strict):
    """What whoever drives asks for; it names the newest beat that they had heard: nothing old is done."""

    beat: Annotated[int, Field(ge=0)]


class Press(Asked):
    """Arm and go on, begin no episode after all while its world is opened, or end what is being learned or made."""

    do: Literal["resume", "withdraw", "cancel"]


class End(Asked):
    """End the episode; ``found``: at its goal, which may be drawn in the picture."""

    do: Literal["end"]
    found: bool
    box: Box | None = None


class Begin(Asked):
    """Begin an episode; in the world and under the conditions that the robot is in, where none are given."""

    world: WorldName | None = None
    variation: WorldName | None = None


class DriveRequest(Begin):
    """Begin a drive by hand to a goal, and record it; ``name`` is what its recording's name begins with."""

    do: Literal["drive"]
    goal: GoalName
    name: EpisodeName | None = None


class Run(Begin):
    """Have the robot search with a model, which is loaded first; one of the paper's scheme has no goal to choose."""

    do: Literal["run"]
    model: FileName
    goal: GoalName | None = None
    start: Start
    seed: Annotated[int, Field(ge=0, lt=2**31)]
    victim: Victim = "there"


class LearnRequest(Asked):
    """Learn a model from recordings, by their names; ``name`` is its file's, without the end."""

    do: Literal["learn"]
    name: Annotated[str, Field(pattern=r"^\w[\w .-]{0,63}$")]
    recordings: Annotated[tuple[str, ...], Field(min_length=1, max_length=1000)]
    scheme: Scheme = "filter"


class Add(Asked):
    """Have a model learn from runs of the robot's own, by their names (`smal learn --add`)."""

    do: Literal["add"]
    model: FileName
    recordings: Annotated[tuple[str, ...], Field(min_length=1, max_length=1000)]


class Delete(Asked):
    """Delete a recording, by its name."""

    do: Literal["delete"]
    recording: str


Ask = Press | End | DriveRequest | Run | LearnRequest | Add | Delete
OF_WATCHERS: TypeAdapter[SeenRequest | StopRequest] = TypeAdapter(
    Annotated[SeenRequest | StopRequest, Field(discriminator="do")]
)
OF_DRIVER: TypeAdapter[Hold | Leave | StopRequest | Ask] = TypeAdapter(
    Annotated[Hold | Leave | StopRequest | Ask, Field(discriminator="do")]
)
