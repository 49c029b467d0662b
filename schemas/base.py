"""The fields that every message carries, and the rules that every message obeys."""

from typing import Annotated, ClassVar, Final, Literal, Self, get_args

from pydantic import BaseModel, ConfigDict, Field

ROBOT_ID_PATTERN: Final = r"^[a-z0-9][a-z0-9_-]{0,31}$"
EPISODE_ID_PATTERN: Final = r"^[a-z0-9][a-z0-9_-]{0,63}$"
MAX_TICK: Final = 10_000_000
NO_EPISODE: Final = "none"  # In the place of an episode, where there is none; every episode has a longer name.

RobotId = Annotated[str, Field(pattern=ROBOT_ID_PATTERN, description="Which robot: lower case, at most 32 characters.")]
EpisodeId = Annotated[str, Field(pattern=EPISODE_ID_PATTERN, description="Which episode: one reset to one end.")]
SessionId = Annotated[
    str,
    Field(pattern=r"^[0-9a-z_-]{0,32}$", description="Which process sends: drawn anew at its start; empty if unsaid."),
]
Tick = Annotated[int, Field(ge=0, le=MAX_TICK, description="Number of the camera frame in the episode, from 0.")]
Atom = Literal["forward", "backward", "left", "right", "stop"]
Source = Literal["emergency_stop", "teleop", "expert", "policy"]
ATOMS: Final[tuple[Atom, ...]] = get_args(Atom)
#: Ahead and counter-clockwise, as shares of a robot's speed and turn rate.
DIRECTIONS: Final[dict[Atom, tuple[int, int]]] = {
    "forward": (1, 0), "backward": (-1, 0), "left": (0, 1), "right": (0, -1), "stop": (0, 0),
}  # fmt: skip
#: From the highest priority to the lowest: the actuator obeys the first source that has a fresh command.
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

    #: Version of this message's fields, and earlier ones that lack fields with defaults; a receiver refuses others.
    version: ClassVar[int] = 1
    reads: ClassVar[tuple[int, ...]] = ()
    max_bytes: ClassVar[int] = 64 * 1024  # Most bytes that this message may take on the wire.
    max_containers: ClassVar[int] = 128  # Most maps and arrays in it; a state has 66 (one a candidate).
    #: Name of the topic, after ``smal/<robot>/``; a class with several topics overrides ``topic_name``.
    topic: ClassVar[str]

    robot: RobotId
    episode: EpisodeId
    tick: Tick
    stamp_ns: Annotated[int, Field(ge=0, lt=2**63)]
    """Capture time of the observation that this message descends from, nanoseconds since 1970 (lockstep: simulated)."""

    @classmethod
    def schema_name(cls) -> str:
        """Name and version as they stand in the encoding, for example ``smal.State/3``."""
        return f"smal.{cls.__name__}/{cls.version}"

    @property
    def topic_name(self) -> str:
        """Name of the topic that this message belongs to."""
        return self.topic

    @classmethod
    def after(cls, cause: "Message", **fields: object) -> Self:
        """Make a message that descends from ``cause``: same robot, episode, tick and stamp."""
        header = {"robot": cause.robot, "episode": cause.episode, "tick": cause.tick, "stamp_ns": cause.stamp_ns}
        return cls.model_validate(header | fields)
