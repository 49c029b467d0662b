"""That the robot is there, and what an operator's sign of life answers to."""

from typing import Annotated, ClassVar

from pydantic import Field

from schemas.base import Message, SessionId
from schemas.command import StopCause


class Pulse(Message):
    """Sign of life of the robot, which its operator answers; between two episodes that of the message is ``none``."""

    topic: ClassVar[str] = "pulse"
    max_bytes: ClassVar[int] = 1024

    session: SessionId
    """The robot's process."""
    number: Annotated[int, Field(ge=1, lt=2**63)]
    """Which one, for who answers it; each is one more than the last, from a number drawn at the start."""
    emergency_stop: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Number of the latched stop, which its release has to name; 0 where none is."""
    stop_cause: StopCause | None = None
    """What latched it."""
