"""Heartbeats of the robot and of its operator."""

from typing import Annotated, ClassVar

from pydantic import Field

from schemas.base import Message, SessionId
from schemas.command import StopCause


class Heartbeat(Message):
    """Heartbeat of an operator, or of a program that drives the robot."""

    topic: ClassVar[str] = "heartbeat"
    max_bytes: ClassVar[int] = 1024

    session: SessionId
    """Sending process."""
    name: Annotated[str, Field(pattern=r"^[a-z0-9_-]{1,32}$")]
    """Kind of the sender, for display: ``teleop``, ``console``."""
    sequence: Annotated[int, Field(ge=0, lt=2**63)]
    """Order of the messages of one process, from 0."""
    answers: Annotated[int | None, Field(ge=1, lt=2**63)] = None
    """Number of the robot's pulse that an operator answers. It dates the heartbeat: without an
    answer to its recent pulses the robot stops. None for a program, whose absence does not stop
    the robot.
    """
    present: bool = True
    """False announces that the sender leaves; its absence then does not stop the robot."""


class Pulse(Message):
    """Heartbeat of the robot, which its operator answers; ``none`` is the episode in between."""

    topic: ClassVar[str] = "pulse"
    max_bytes: ClassVar[int] = 1024

    session: SessionId
    """The robot's process."""
    number: Annotated[int, Field(ge=1, lt=2**63)]
    """Number of the pulse, which answers repeat; it counts up from a random start."""
    latched_stop: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Number of the latched stop, which its release must name; 0 without a stop."""
    stop_cause: StopCause | None = None
    """Cause of the latched stop."""
