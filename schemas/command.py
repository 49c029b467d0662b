"""Commands to the actuator, and what the actuator did."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from schemas.base import MAX_TICK, Atom, Message, SessionId, Source

#: Why the robot stands until it is armed: it was started and is not armed yet; an emergency stop; the operator fell
#: silent; or what drives its wheels failed.
StopCause = Literal["not_armed", "emergency_stop", "operator_lost", "fault"]


class Command(Message):
    """One atom movement asked of the robot by one source."""

    version: ClassVar[int] = 2
    reads: ClassVar[tuple[int, ...]] = (1,)
    topic: ClassVar[str] = "command"
    max_bytes: ClassVar[int] = 1024

    source: Source
    """Who asks; also the last part of the key."""
    session: SessionId = ""
    """The process that asks; while one is heard the robot obeys no other of the same source."""
    sequence: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    """Order of the commands that one source sends for one tick, from 0."""
    atom: Atom
    """The movement."""
    speed: Annotated[float, Field(ge=0, le=1)] = 1.0
    """Fraction of the robot's nominal speed, 0 to 1."""

    @property
    def topic_name(self) -> str:
        """``command/<source>``."""
        return f"command/{self.source}"


class CommandApplied(Message):
    """What the actuator does from this tick on; the heartbeat of the robot."""

    version: ClassVar[int] = 5
    reads: ClassVar[tuple[int, ...]] = (2, 3, 4)
    topic: ClassVar[str] = "command/applied"

    sequence: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    """Order within the tick, from 0; the last of a tick is what moved the robot on to the next frame."""

    atom: Atom
    """The movement carried out."""
    speed: Annotated[float, Field(ge=0, le=1)]
    """Fraction of the nominal speed."""
    ahead: Annotated[float, Field(ge=-1, le=1)] = 0.0
    """Fraction of the nominal speed that it goes ahead at in turning, as a car does: 0 of a turn on the spot."""
    source: Source | None
    """Whose command it is; none when the robot stands for want of one."""
    reason: Literal["command", "obstacle", "silence", "taken_over", "emergency_stop"]
    """Why: a fresh command; one that is carried out slower, or not, since something is in the way or nothing tells that
    it is free; no fresh command from the driver, none from the person who has taken over, or a latched stop."""
    emergency_stop: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Number of the latched stop, which its release has to name; 0 where none is."""
    stop_cause: StopCause | None = None
    """What latched it."""
    answered_tick: Annotated[int | None, Field(ge=0, le=MAX_TICK)] = None
    """The frame that the obeyed command answered, at or before this tick; none without a command of this episode."""
    latency_ns: Annotated[int | None, Field(ge=0, lt=2**63)] = None
    """From the readiness of frame ``answered_tick`` (rendered, about to be sent) to the acceptance of the obeyed
    command, on the actuator's clock."""
    delay_ns: Annotated[int | None, Field(ge=0, lt=2**63)] = None
    """From the capture of frame ``answered_tick`` to the moment when the obeyed command began to move the robot, on the
    clock of its world: 0 in lockstep."""
    refused: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Commands refused so far in this episode."""
