"""Beginnings and ends of episodes."""

import re
from typing import Annotated, ClassVar, Final, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from schemas.base import Message, Source

Purpose = Literal["drive", "recovery", "run"]
EventName = Literal["started", "victim_found", "collision", "timed_out", "ended"]
Outcome = Literal["found", "false_goal", "missed", "not_here", "collision", "timeout", "aborted"]
Said = Literal["found", "not_here"]  # What a robot says that ends its run.
#: How the victim of a simulated run lies: as in the world; nowhere; a little elsewhere; something else in its place.
Victim = Literal["there", "absent", "moved", "decoy"]
Judge = Literal["task", "operator"]


_GOAL: Final = re.compile(r"\w[\w .-]{0,63}")


def _names_a_place(goal: str) -> str:
    if _GOAL.fullmatch(goal) is None:
        raise ValueError(
            "a name has 1 to 64 letters, digits, spaces, . - or _, and begins with a letter, a digit or _"
        )
    return goal


#: Name of a place that drives lead to: letters, digits, and what may stand between them.
GoalName = Annotated[
    str, AfterValidator(_names_a_place), Field(json_schema_extra={"pattern": f"^{_GOAL.pattern}$"})
]


_LEAST: Final = 0.05  # Of the picture's width and height: a box of fewer pixels tells nothing.


def _has_an_area(box: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    left, top, right, bottom = box
    if right - left < _LEAST or bottom - top < _LEAST:
        raise ValueError(
            "a box is left, top, right and bottom, and has at least a twentieth of the picture each way"
        )
    return box


_Share = Annotated[float, Field(ge=0, le=1)]
#: Where something is in a picture: left, top, right and bottom, shares of its width and height.
Box = Annotated[tuple[_Share, _Share, _Share, _Share], AfterValidator(_has_an_area)]


def in_words(outcome: Outcome | None, right: bool | None) -> str:
    """Return how an episode ended, and whether what was said is so where somebody knows, for people."""
    return (outcome or "").replace("_", " ") + {True: ", rightly", False: ", wrongly", None: ""}[
        right
    ]


class Episode(Message):
    """Something that happened to the episode as a whole; ``started`` is its first message, ``ended`` its last."""

    topic: ClassVar[str] = "episode"

    event: EventName
    """What happened."""
    purpose: Purpose
    """drive: a whole demonstration; recovery: a short one that begins off the route; run: the robot by itself."""
    driver: Source
    """Who drives; the gate refuses other drivers."""
    world: Annotated[str, Field(min_length=1, max_length=255)]
    """Name of the world; of a real robot's body where there is none."""
    seed: Annotated[int, Field(ge=0, lt=2**63)]
    """Seed of start pose and actuation noise."""
    goal: GoalName = "victim"
    """Where a drive leads, by the name that it has for those who send the robot there."""
    outcome: Outcome | None = None
    """How it ended; given with ``ended`` only. found: the goal was reached in the last frame (tick of this message),
    and where a run ends by the robot's word it said so. false_goal: it said so, and was wrong. missed: it reached the
    goal, and said nothing until its time was out. not_here: it said that the goal is not there. aborted: somebody ended
    it, or nobody was there to judge what it said."""
    judge: Judge | None = None
    """Who says so of ``found``: the task (in simulation: near the victim, and the victim in view), or the operator."""
    right: bool | None = None
    """Whether ``not_here`` is so; None where nobody knows."""
    box: Box | None = None
    """Where the goal is in the last frame, where the operator who found it has drawn that."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.event == "ended") != (self.outcome is not None):
            raise ValueError("outcome is given exactly with the event 'ended'")
        if self.judge is not None and self.outcome != "found":
            raise ValueError("judge is given with the outcome 'found' only")
        if self.box is not None and self.judge != "operator":
            raise ValueError("box is given with the judge 'operator' only")
        if self.right is not None and self.outcome != "not_here":
            raise ValueError("right is given with the outcome 'not_here' only")
        return self
