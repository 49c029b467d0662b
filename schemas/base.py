"""Fields and rules that all messages share."""

from typing import Annotated, ClassVar, Final, Literal, NamedTuple, Self, get_args

from pydantic import BaseModel, ConfigDict, Field

ROBOT_ID_PATTERN: Final = r"^[a-z0-9][a-z0-9_-]{0,31}$"
EPISODE_ID_PATTERN: Final = r"^[a-z0-9][a-z0-9_-]{0,63}$"
MAX_TICK: Final = 10_000_000
# Placeholder for an episode; every real episode has a longer name.
NO_EPISODE: Final = "none"

RobotId = Annotated[
    str,
    Field(pattern=ROBOT_ID_PATTERN, description="Robot id: lower case, at most 32 characters."),
]
EpisodeId = Annotated[
    str,
    Field(
        pattern=EPISODE_ID_PATTERN,
        description="Episode id; an episode lasts from one reset to one end.",
    ),
]
SessionId = Annotated[
    str,
    Field(
        pattern=r"^[0-9a-z_-]{0,32}$",
        description="Random id of the sending process, new at each start; empty if not given.",
    ),
]
Tick = Annotated[
    int, Field(ge=0, le=MAX_TICK, description="Number of the camera frame in the episode, from 0.")
]
# Time between two camera frames, seconds (10 Hz).
TICK_S: Final = 0.1
Atom = Literal["forward", "backward", "left", "right", "stop"]
Source = Literal["emergency_stop", "teleop", "expert", "policy"]
ATOMS: Final[tuple[Atom, ...]] = get_args(Atom)


# Dead zone of joysticks: a robot below this share of its speed stands.
STILL: Final = 0.1
# Share of the turn rate from which an atom is a turn: half, the threshold of rounding.
TURNING: Final = 0.5


class Velocity(NamedTuple):
    """Forward and left-turning velocity as shares of the robot's speed and turn rate, -1 to 1.

    Shares need no knowledge of the robot's speed, and they cannot exceed it.
    """

    linear: float
    angular: float

    @property
    def keys(self) -> list[Atom]:
        """The keys that the velocity consists of; it is allowed if all its keys are."""
        # A slight bend stays within the view straight ahead.
        angular = 0.0 if self.linear and abs(self.angular) < STILL else self.angular
        return [
            atom
            for atom, key in KEYS.items()
            if self.linear * key.linear + angular * key.angular > 0.0
        ]

    def atom(self, still: float = STILL, turning: float = TURNING) -> Atom:
        """Return the nearest atom."""
        if max(map(abs, self)) < still:
            return "stop"
        if abs(self.linear) < still or abs(self.angular) >= turning:
            return "left" if self.angular > 0.0 else "right"
        return "forward" if self.linear > 0.0 else "backward"


STANDING: Final = Velocity(0.0, 0.0)
KEYS: Final[dict[Atom, Velocity]] = {
    "forward": Velocity(1.0, 0.0), "backward": Velocity(-1.0, 0.0), "left": Velocity(0.0, 1.0),
    "right": Velocity(0.0, -1.0), "stop": STANDING,
}  # fmt: skip
#: Sources of commands; see `services.robot.gate` for their precedence.
SOURCES: Final[tuple[Source, ...]] = get_args(Source)


class Strict(BaseModel):
    """Frozen model that refuses unknown fields, implicit conversions, NaN and infinity."""

    model_config = ConfigDict(
        frozen=True,
        strict=True,
        extra="forbid",
        allow_inf_nan=False,
        ser_json_bytes="base64",
        val_json_bytes="base64",
        use_attribute_docstrings=True,
    )


class Message(Strict):
    """Message on a topic, with its robot, its time and the observation that it descends from."""

    #: Version of this message's fields; a receiver rejects all others.
    version: ClassVar[int] = 1
    max_bytes: ClassVar[int] = 64 * 1024  # Maximum size on the wire, bytes.
    # Maximum number of maps and arrays in it.
    max_containers: ClassVar[int] = 128
    #: Name of the topic, after ``smal/<robot>/``; a class with several topics overrides
    #: ``topic_name``.
    topic: ClassVar[str]

    robot: RobotId
    episode: EpisodeId
    tick: Tick
    stamp_ns: Annotated[int, Field(ge=0, lt=2**63)]
    """Capture time of the observation that this message descends from, nanoseconds since 1970
    (simulated in lockstep).
    """

    @classmethod
    def schema_name(cls) -> str:
        """Name and version, as in the encoding: ``smal.State/1``."""
        return f"smal.{cls.__name__}/{cls.version}"

    @property
    def topic_name(self) -> str:
        """Name of the topic that this message belongs to."""
        return self.topic

    def since(self, stamp_ns: int | None) -> float | None:
        """Return the seconds since another frame, at least 0; None if its stamp is None."""
        return None if stamp_ns is None else max(self.stamp_ns - stamp_ns, 0) / 1e9

    @classmethod
    def after(cls, cause: "Message", **fields: object) -> Self:
        """Create a message that descends from ``cause``: same robot, episode, tick and stamp."""
        header = {
            "robot": cause.robot,
            "episode": cause.episode,
            "tick": cause.tick,
            "stamp_ns": cause.stamp_ns,
        }
        return cls.model_validate(header | fields)
