"""State that a service passes to the next instance of a robot."""

from typing import Annotated, Literal

from pydantic import Field

from schemas.base import Message
from schemas.rpc import LoadRequest
from schemas.state import State

Number = Annotated[float, Field(ge=-1e6, le=1e6)]


class Snapshot(Message):
    """State that another instance of the service continues from when it takes over the robot."""

    service: Literal["recognition", "policy"]
    """Name of the service."""
    checksum: Annotated[str, Field(pattern=r"^[0-9a-f]{8,64}$")]
    """Beginning of the checksum of the model in use; snapshots of another model are refused."""
    model: LoadRequest | None = None
    """Call that loaded the model; None for the model of the settings."""
    state: State | None = None
    """Belief at the robot's last frame (recognition only)."""
    wheels: tuple[Number, Number, Number] | None = None
    """Odometry of that frame: x and y in metres, heading in radians."""

    @property
    def topic_name(self) -> str:
        """Name of the topic that this message belongs to."""
        return f"snapshot/{self.service}"
