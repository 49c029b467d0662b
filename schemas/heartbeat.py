"""That the robot, and who is responsible for what it does, are still there."""

from typing import Annotated, ClassVar

from pydantic import Field

from schemas.base import Message, SessionId
from schemas.command import StopCause


class Heartbeat(Message):
    """Sign of life of whoever is responsible for what the robot does."""

    topic: ClassVar[str] = "heartbeat"
    max_bytes: ClassVar[int] = 1024

    session: SessionId
    """The process that sends."""
    name: Annotated[str, Field(pattern=r"^[a-z0-9_-]{1,32}$")]
    """What it is, for others who have to wait for it: ``teleop``, ``console``."""
    sequence: Annotated[int, Field(ge=0, lt=2**63)]
    """Order of what one process sends, from 0."""
    answers: Annotated[int | None, Field(ge=1, lt=2**63)] = None
    """Number of the robot's pulse that an operator answers, so that it tells of that moment and of no later one; when
    the robot has no answer to its recent ones it stands. None for a program, which is not missed."""
    present: bool = True
    """False says good-bye; whoever leaves so is not missed."""


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
