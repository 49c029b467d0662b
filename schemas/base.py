"""The fields that every message carries, and the rules that every message obeys."""

from typing import Annotated, ClassVar, Final, Literal, NamedTuple, Self, get_args

from pydantic import BaseModel, ConfigDict, Field

ROBOT_ID_PATTERN: Final = r"^[a-z0-9][a-z0-9_-]{0,31}$"
EPISODE_ID_PATTERN: Final = r"^[a-z0-9][a-z0-9_-]{0,63}$"
MAX_TICK: Final = 10_000_000
NO_EPISODE: Final = (
    "none"  # In the place of an episode, where there is none; every episode has a longer name.
)

RobotId = Annotated[
    str,
    Field(pattern=ROBOT_ID_PATTERN, description="Which robot: lower case, at most 32 characters."),
]
EpisodeId = Annotated[
    str, Field(pattern=EPISODE_ID_PATTERN, description="Which episode: one reset to one end.")
]
SessionId = Annotated[
    str,
    Field(
        pattern=r"^[0-9a-z_-]{0,32}$",
        description="Which process sends: drawn anew at its start; empty if unsaid.",
    ),
]
Tick = Annotated[
    int, Field(ge=0, le=MAX_TICK, description="Number of the camera frame in the episode, from 0.")
]
Atom = Literal["forward", "backward", "left", "right", "stop"]
Source = Literal["emergency_stop", "teleop", "expert", "policy"]
ATOMS: Final[tuple[Atom, ...]] = get_args(Atom)


STILL: Final = 0.1  # Below this share a robot stands: joysticks' dead zone.
TURNING: Final = 0.5  # From this share of its turn rate on it turns: the nearer of all and nothing.


class Velocity(NamedTuple):
    """Linear, ahead, and angular, to the left: shares of a robot's own speed and turn rate, -1 to 1.

    Who drives by keys, or by a map of the robot's own ways, need not know how fast it is, and none can ask too much.
    """

    linear: float
    angular: float

    @property
    def keys(self) -> list[Atom]:
        """The keys that it is made of: one goes so far as what any of them may not."""
        # Hardly a bend, in driving: all that sees straight ahead sees it.
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
#: Keys are five velocities.
KEYS: Final[dict[Atom, Velocity]] = {
    "forward": Velocity(1.0, 0.0), "backward": Velocity(-1.0, 0.0), "left": Velocity(0.0, 1.0),
    "right": Velocity(0.0, -1.0), "stop": STANDING,
}  # fmt: skip
#: The sources of commands; `services.robot.gate` says which one the robot obeys.
SOURCES: Final[tuple[Source, ...]] = get_args(Source)


class Strict(BaseModel):
    """A frozen model that refuses unknown fields, implicit conversions, NaN and infinity."""

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
    """A message on a topic: who, when, and the observation that it descends from."""

    #: Version of this message's fields; a receiver rejects all others.
    version: ClassVar[int] = 1
    max_bytes: ClassVar[int] = 64 * 1024  # Most bytes that this message may take on the wire.
    max_containers: ClassVar[int] = (
        128  # Most maps and arrays in it; a state has 66 (one a candidate).
    )
    #: Name of the topic, after ``smal/<robot>/``; a class with several topics overrides ``topic_name``.
    topic: ClassVar[str]

    robot: RobotId
    episode: EpisodeId
    tick: Tick
    stamp_ns: Annotated[int, Field(ge=0, lt=2**63)]
    """Capture time of the observation that this message descends from, nanoseconds since 1970 (lockstep: simulated)."""

    @classmethod
    def schema_name(cls) -> str:
        """Name and version as they stand in the encoding, for example ``smal.State/1``."""
        return f"smal.{cls.__name__}/{cls.version}"

    @property
    def topic_name(self) -> str:
        """Name of the topic that this message belongs to."""
        return self.topic

    @classmethod
    def after(cls, cause: "Message", **fields: object) -> Self:
        """Make a message that descends from ``cause``: same robot, episode, tick and stamp."""
        header = {
            "robot": cause.robot,
            "episode": cause.episode,
            "tick": cause.tick,
            "stamp_ns": cause.stamp_ns,
        }
        return cls.model_validate(header | fields)
