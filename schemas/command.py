"""Commands to the actuator, and the motion that results."""

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from schemas.base import ATOMS, KEYS, MAX_TICK, Atom, Message, SessionId, Source, Velocity

#: Causes of a latched stop: not armed since its start; an emergency stop; a lost operator; odometry
#: that contradicts the commands; or a fault of the wheel driver.
StopCause = Literal["not_armed", "emergency_stop", "operator_lost", "wheels", "fault"]
#: Reasons to execute a command, in whole or limited.
Limit = Literal["command", "obstacle", "no_depth", "insisted", "radius"]
#: Reasons to stand without a command.
Stand = Literal["silence", "taken_over", "deaf", "latched_stop"]
#: Reason for the motion; `CommandApplied.reason` describes each.
Reason = Literal[Limit, Stand]


Share = Annotated[float, Field(ge=-1, le=1)]


class _Moving(Message):
    """Velocity as shares of the robot's speed and turn rate."""

    linear: Share
    """Share of the robot's nominal speed, forward; negative values go backward."""
    angular: Share
    """Share of its nominal turn rate, to the left; negative values turn right."""

    @property
    def velocity(self) -> Velocity:
        """Both shares."""
        return Velocity(self.linear, self.angular)


class Command(_Moving):
    """Velocity that one source commands."""

    topic: ClassVar[str] = "command"
    max_bytes: ClassVar[int] = 1024

    source: Source
    """Source of the command; also the last part of the key."""
    session: SessionId = ""
    """Sending process; while it is active, the robot refuses other processes of the same source."""
    sequence: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    """Order of the commands that one source sends within a tick, from 0."""
    insists: bool = False
    """Whether a person has seen the obstacle and lets the robot continue slowly; ignored for other
    sources.
    """

    @model_validator(mode="before")
    @classmethod
    def _of_key(cls, fields: Any) -> Any:  # noqa: ANN401 - it may be anything
        """Accept a key, ``atom`` at a share ``speed``, in place of a velocity."""
        if not isinstance(fields, dict) or "atom" not in fields:
            return fields
        atom = fields["atom"]
        speed = fields.get("speed", 1.0)
        if atom not in ATOMS or not isinstance(speed, int | float):
            raise ValueError(
                f"invalid key: atom must be one of {', '.join(ATOMS)} and speed a number, "
                f"got {atom!r:.20} and {speed!r:.20}"
            )
        key = KEYS[atom]
        rest = {name: value for name, value in fields.items() if name not in ("atom", "speed")}
        return {"linear": key.linear * speed, "angular": key.angular * speed} | rest

    @property
    def atom(self) -> Atom:
        """The nearest key."""
        return self.velocity.atom()

    @property
    def topic_name(self) -> str:
        """``command/<source>``."""
        return f"command/{self.source}"


class CommandApplied(_Moving):
    """Motion of the actuator from this tick on; also the robot's heartbeat."""

    topic: ClassVar[str] = "command/applied"

    sequence: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    """Order within the tick, from 0; the last message moved the robot to the next frame."""

    atom: Atom
    """The nearest of the five keys, for display and for the paper's scheme."""
    source: Source | None
    """Source of the obeyed command; None if the robot stands without a command."""
    reason: Reason
    """command: a fresh command. obstacle: the command is slowed or stopped because of an obstacle,
    or because the ground is not known to be free. no_depth: the depth camera shows no ground, or
    too late. insisted: a person insists, and the robot continues slowly. radius: the command
    turns more sharply than the robot can. silence: no fresh command of the driver. taken_over:
    no fresh command of the person who took over. deaf: no echo by a link that carries stops or
    commands. latched_stop: a stop of any cause, until it is released.
    """
    latched_stop: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Number of the latched stop, which its release must name; 0 without a stop."""
    stop_cause: StopCause | None = None
    """Cause of the latched stop."""
    answered_tick: Annotated[int | None, Field(ge=0, le=MAX_TICK)] = None
    """Frame that the obeyed command answers, at or before this tick; None without a command of this
    episode.
    """
    latency_ns: Annotated[int | None, Field(ge=0, lt=2**63)] = None
    """Latency from the readiness of frame ``answered_tick`` (rendered, about to be sent) to the
    acceptance of the obeyed command, by the actuator's clock.
    """
    delay_ns: Annotated[int | None, Field(ge=0, lt=2**63)] = None
    """Delay from the capture of frame ``answered_tick`` to the motion by the obeyed command, by the
    clock of its world: 0 in lockstep.
    """
    refused: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Number of commands refused in this episode."""
