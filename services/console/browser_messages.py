"""What a browser may say: every message is one of these, or the connection ends."""

from __future__ import annotations

from typing import Annotated, Final, Literal

from pydantic import Field, TypeAdapter

from schemas.base import Atom, Strict
from schemas.episode import GoalName
from schemas.rpc import EpisodeName, FileName, Scheme, Start, WorldName

#: Name of a model that is learned: its file's, without the end.
ModelName = Annotated[str, Field(pattern=r"^\w[\w .-]{0,63}$")]
Seed = Annotated[int, Field(ge=0, lt=2**31)]
#: What is said of what came late.
LATE: Final = "that came too late to be done: the connection is slow, or was away; press again"


class Seen(Strict):
    """A watcher has taken what was sent, and may be sent more."""

    do: Literal["seen"]


class Stop(Strict):
    """Emergency stop; anybody's to say."""

    do: Literal["stop"]


class Hold(Strict):
    """The answer to a beat: the person is there, and holds a key or none."""

    do: Literal["hold"]
    beat: Annotated[int, Field(ge=0)]
    """Which beat is answered; an old one says nothing of now."""
    atom: Atom | None
    """The movement whose key is held."""


class Leave(Strict):
    """The person stands up; they are not missed."""

    do: Literal["leave"]


class Asked(Strict):
    """What whoever drives asks for."""

    beat: Annotated[int, Field(ge=0)]
    """The newest beat that they had heard; what was asked long ago is not done."""


class Resume(Asked):
    """Arm the robot, and have the driver go on that the person took over from."""

    do: Literal["resume"]


class End(Asked):
    """End the episode."""

    do: Literal["end"]
    found: bool
    """Whether the goal is reached."""


class Begin(Asked):
    """Begin an episode."""

    world: WorldName | None = None
    """In which world; in the one that it is in if not given."""
    variation: WorldName | None = None
    """Under which conditions; those that it is in if not given."""


class Drive(Begin):
    """Begin a drive by hand, and record it."""

    do: Literal["drive"]
    goal: GoalName
    """Where it leads."""
    name: EpisodeName | None = None
    """What its recording's name begins with."""


class Run(Begin):
    """Have the robot search by itself."""

    do: Literal["run"]
    model: FileName
    """With which model; recognition and policy load it first."""
    goal: GoalName | None = None
    """Where to; a model of the paper's scheme goes to the nearest goal."""
    start: Start
    """Where it begins."""
    seed: Seed
    """Which of the starts."""


class Learn(Asked):
    """Learn a model."""

    do: Literal["learn"]
    name: ModelName
    """What it will be called."""
    recordings: Annotated[tuple[str, ...], Field(min_length=1, max_length=1000)]
    """From which recordings, by name."""
    scheme: Scheme = "filter"
    """How a robot is to go by it."""


class Withdraw(Asked):
    """Begin no episode after all, while its world is being opened."""

    do: Literal["withdraw"]


class Cancel(Asked):
    """End what is being learned or made."""

    do: Literal["cancel"]


class Delete(Asked):
    """Delete a recording."""

    do: Literal["delete"]
    recording: str
    """Its name."""


Ask = Resume | End | Drive | Run | Withdraw | Learn | Cancel | Delete
OF_WATCHERS: TypeAdapter[Seen | Stop] = TypeAdapter(Annotated[Seen | Stop, Field(discriminator="do")])
OF_DRIVER: TypeAdapter[Hold | Leave | Stop | Ask] = TypeAdapter(
    Annotated[Hold | Leave | Stop | Ask, Field(discriminator="do")]
)
