"""Commands to the actuator, and what the actuator did."""

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from schemas.base import ATOMS, KEYS, MAX_TICK, Atom, Message, SessionId, Source, Velocity

#: Why the robot stands until it is armed: it was started and is not armed yet; an emergency stop; the operator fell
#: silent; the odometry contradicts the commands; or what drives its wheels failed.
StopCause = Literal["not_armed", "emergency_stop", "operator_lost", "wheels", "fault"]


Share = Annotated[float, Field(ge=-1, le=1)]


class _Moving(Message):
    """How the robot moves."""

    linear: Share
    """Fraction of the robot's nominal speed that it goes ahead at; negative back."""
    angular: Share
    """Fraction of its nominal turn rate that it turns to the left at; negative to the right."""

    @property
    def velocity(self) -> Velocity:
        """Both."""
        return Velocity(self.linear, self.angular)


class Command(_Moving):
    """A velocity asked of the robot by one source."""

    topic: ClassVar[str] = "command"
    max_bytes: ClassVar[int] = 1024

    source: Source
    """Who asks; also the last part of the key."""
    session: SessionId = ""
    """The process that asks; while one is heard the robot obeys no other of the same source."""
    sequence: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    """Order of the commands that one source sends for one tick, from 0."""
    insists: bool = False
    """Whether a person has seen that the robot stands before something, and has it go on, slowly; of others nothing."""

    @model_validator(mode="before")
    @classmethod
    def _of_key(cls, fields: Any) -> Any:  # noqa: ANN401 - it may be anything
        """Accept a key, ``atom`` at a fraction ``speed``, in place of a velocity."""
        if not isinstance(fields, dict) or "atom" not in fields:
            return fields
        atom = fields["atom"]
        speed = fields.get("speed", 1.0)
        if atom not in ATOMS or not isinstance(speed, int | float):
            raise ValueError(
                f"a key is one of {', '.join(ATOMS)} and a number, got {atom!r:.20} and {speed!r:.20}"
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
    """What the actuator does from this tick on; the heartbeat of the robot."""

    topic: ClassVar[str] = "command/applied"

    sequence: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    """Order within the tick, from 0; the last of a tick is what moved the robot on to the next frame."""

    atom: Atom
    """The nearest of the five keys, for people and for the paper's scheme."""
    source: Source | None
    """Whose command it is; none when the robot stands for want of one."""
    reason: Literal[
        "command",
        "obstacle",
        "no_depth",
        "insisted",
        "radius",
        "silence",
        "taken_over",
        "deaf",
        "emergency_stop",
    ]
    """Why: a fresh command; a command that is carried out slower, or not, because something is in the way or the ground
    is not known to be free, or because the depth camera shows no ground, or shows it too late (`no_depth`); a command
    that is carried out there slowly, because a person insists; a command that turns more sharply than the robot can; no
    fresh command from the driver, or from the person who has taken over; no echo by a link on which stops or commands
    come (`deaf`); or a latched stop."""
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
