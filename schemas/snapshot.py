"""What a service hands on with a robot, to the instance that serves it next."""

from typing import Annotated, Literal

from pydantic import Field

from schemas.base import Message
from schemas.rpc import LoadRequest
from schemas.state import State

Number = Annotated[float, Field(ge=-1e6, le=1e6)]


class Snapshot(Message):
    """What another instance of the service goes on from, should the robot become its own."""

    service: Literal["recognition", "policy"]
    """Which service."""
    checksum: Annotated[str, Field(pattern=r"^[0-9a-f]{8,64}$")]
    """Beginning of the checksum of the model in use; what belongs to another one is refused."""
    model: LoadRequest | None = None
    """By which call it was loaded; none where it is that of the settings."""
    state: State | None = None
    """Where the robot was believed to be at its last frame; of recognition."""
    wheels: tuple[Number, Number, Number] | None = None
    """The odometry of that frame: x and y in metres, heading in radians."""

    @property
    def topic_name(self) -> str:
        """Name of the topic that this message belongs to."""
        return f"snapshot/{self.service}"
