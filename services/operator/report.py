"""What was last heard of the robot: whoever shows it to a person draws this."""

from dataclasses import dataclass

from schemas.base import Atom, Source
from schemas.command import StopCause
from schemas.episode import Episode, Outcome, Purpose


@dataclass(frozen=True)
class Report:
    """What was last heard of the robot, and of its episode."""

    at: float = 0.0  # When it last told of itself, by the operator's clock.
    answers: bool = False
    waiting: bool = False  # An episode was asked for, and has not begun yet.
    emergency: bool = False  # An emergency stop was asked for here, and the robot was not armed since.
    cause: StopCause | None = None  # Why the robot stands until it is armed.
    episode: str | None = None  # The running episode; none where there is none.
    tick: int = 0  # Of the running episode, or of the last one: its newest frame, and how the robot moved.
    atom: Atom | None = None
    source: Source | None = None
    reason: str | None = None
    refused: int = 0
    purpose: Purpose | None = None  # How the episode was begun; None where nobody has told.
    driver: Source | None = None
    goal: str | None = None
    world: str | None = None
    outcome: Outcome | None = None  # How it ended.
    right: bool | None = None  # Whether what it said is so, of "not here"; None where nobody knows.


def told_of(event: Episode) -> str:
    """Return how an episode ended, for people."""
    rightly = {True: ", rightly", False: ", wrongly", None: ""}[event.right]
    return (event.outcome or "").replace("_", " ") + rightly
