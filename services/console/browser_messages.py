"""Messages of browsers; an invalid message ends the connection of a watcher."""

from typing import Annotated, Final, Literal

from pydantic import Field, TypeAdapter

from schemas.base import Strict
from schemas.command import Share
from schemas.episode import Box, GoalName, Victim
from schemas.rpc import (
    MAX_TICKS,
    EpisodeName,
    FileName,
    HeadingRad,
    Metres,
    Point,
    Scheme,
    Start,
    WorldName,
)

#: File name without folder and suffix.
Label = Annotated[str, Field(pattern=r"^\w[\w .-]{0,63}$")]
# Refusal of a late message.
LATE: Final = "request too late: the connection is slow or was interrupted; press again"


class SeenRequest(Strict):
    """A watcher has drawn the last update and can take the next."""

    do: Literal["seen"]


class StopRequest(Strict):
    """Emergency stop, open to every browser."""

    do: Literal["stop"]


class Hold(Strict):
    """Answer to a beat: the operator is present and holds a velocity (keys or stick), or none."""

    do: Literal["hold"]
    beat: Annotated[int, Field(ge=0)]
    held: tuple[Share, Share] | None  # Linear and angular.


class Leave(Strict):
    """The driver leaves the seat; the robot does not miss them."""

    do: Literal["leave"]


class Asked(Strict):
    """Request of the driver; contains the latest beat, so that late requests are dropped."""

    beat: Annotated[int, Field(ge=0)]


class Press(Asked):
    """Arm and resume, withdraw the episode while its world opens, or cancel the running job."""

    do: Literal["resume", "withdraw", "cancel"]


class End(Asked):
    """End the episode; ``found``: at its goal, optionally with a box in the image."""

    do: Literal["end"]
    found: bool
    box: Box | None = None


class Begin(Asked):
    """Begin an episode; by default in the current world and variation."""

    world: WorldName | None = None
    variation: WorldName | None = None


class DriveRequest(Begin):
    """Begin a recorded drive by hand to a goal; ``name`` is the prefix of the recording's name."""

    do: Literal["drive"]
    goal: GoalName
    name: EpisodeName | None = None


class Run(Begin):
    """Load a model and begin a run; models of the paper's scheme have a fixed goal."""

    do: Literal["run"]
    model: FileName
    goal: GoalName | None = None
    start: Start
    seed: Annotated[int, Field(ge=0, lt=2**31)]
    victim: Victim = "there"
    obstacles: Annotated[int, Field(ge=0, le=50)] = 0
    people: Annotated[int, Field(ge=0, le=50)] = 0
    kidnap_tick: Annotated[int, Field(ge=1, le=MAX_TICKS)] | None = None


class Carry(Asked):
    """Carry the simulated robot to a pose in its world."""

    do: Literal["carry"]
    x_m: Metres
    y_m: Metres
    heading_rad: HeadingRad


class ChooseTask(Asked):
    """Choose start and goal in the world of the simulated robot."""

    do: Literal["task"]
    start: Point
    goal: Point


class LearnRequest(Asked):
    """Learn a model from recordings, under a name."""

    do: Literal["learn"]
    name: Label
    recordings: Annotated[tuple[str, ...], Field(min_length=1, max_length=1000)]
    scheme: Scheme = "filter"


class Add(Asked):
    """Add the robot's own runs to a model (`smal learn --add`)."""

    do: Literal["add"]
    model: FileName
    recordings: Annotated[tuple[str, ...], Field(min_length=1, max_length=1000)]


class Delete(Asked):
    """Delete a recording or a model."""

    do: Literal["delete"]
    file: str


class Rename(Asked):
    """Rename a recording or a model; ``name`` is the new name without suffix."""

    do: Literal["rename"]
    file: str
    name: Label


Ask = Press | End | DriveRequest | Run | Carry | ChooseTask | LearnRequest | Add | Delete | Rename
OF_WATCHERS: TypeAdapter[SeenRequest | StopRequest] = TypeAdapter(
    Annotated[SeenRequest | StopRequest, Field(discriminator="do")]
)
OF_DRIVER: TypeAdapter[Hold | Leave | StopRequest | Ask] = TypeAdapter(
    Annotated[Hold | Leave | StopRequest | Ask, Field(discriminator="do")]
)
