"""Start and end of episodes."""

import re
from typing import Annotated, ClassVar, Final, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from schemas.base import Message, Source

Purpose = Literal["drive", "recovery", "run"]
#: kidnapped: a simulated robot was moved elsewhere just before the frame, unknown to its odometry.
EventName = Literal["started", "kidnapped", "victim_found", "collision", "timed_out", "ended"]
Outcome = Literal["found", "false_goal", "missed", "not_here", "collision", "timeout", "aborted"]
Said = Literal["found", "not_here"]  # Results that a robot can report to end its run.
#: Variant of the victim in a simulated run: as in the world; absent; moved a little; replaced by
#: another object.
Victim = Literal["there", "absent", "moved", "decoy"]
Judge = Literal["task", "operator"]


_GOAL: Final = re.compile(r"\w[\w .-]{0,63}")


def _names_a_place(goal: str) -> str:
    if _GOAL.fullmatch(goal) is None:
        raise ValueError(
            "invalid name: use 1 to 64 letters, digits, spaces, . - or _, "
            "beginning with a letter, a digit or _"
        )
    return goal


GoalName = Annotated[
    str, AfterValidator(_names_a_place), Field(json_schema_extra={"pattern": f"^{_GOAL.pattern}$"})
]


# Minimum share of the picture's width and height: smaller boxes have too few pixels to learn from.
_LEAST: Final = 0.05


def _has_an_area(box: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    left, top, right, bottom = box
    if right - left < _LEAST or bottom - top < _LEAST:
        raise ValueError(
            "invalid box: give left, top, right and bottom, at least 0.05 of the picture each way"
        )
    return box


_Share = Annotated[float, Field(ge=0, le=1)]
#: Box in a picture: left, top, right and bottom as shares of its width and height.
Box = Annotated[tuple[_Share, _Share, _Share, _Share], AfterValidator(_has_an_area)]


_WORDS: Final[dict[Outcome | None, str]] = {
    "found": "found", "collision": "collision", "timeout": "out of time", "aborted": "ended before the goal",
    "false_goal": "it reported “found”, wrongly", "missed": "it passed the goal without a report",
    "not_here": "it reported “not here”", None: "end not recorded",
}  # fmt: skip
_RIGHT: Final = {True: ", rightly", False: ", wrongly", None: ""}


def in_words(outcome: Outcome | None, right: bool | None = None) -> str:
    """Return the outcome in words, with whether the robot's report is right if that is known."""
    return _WORDS[outcome] + _RIGHT[right]


class Episode(Message):
    """Event of the whole episode; ``started`` is its first message, ``ended`` its last."""

    topic: ClassVar[str] = "episode"

    event: EventName
    """Event."""
    purpose: Purpose
    """drive: a whole demonstration. recovery: a short demonstration that begins off the route. run:
    an autonomous run.
    """
    driver: Source
    """Driver of the episode; the gate refuses other drivers."""
    world: Annotated[str, Field(min_length=1, max_length=255)]
    """Name of the world; for a real robot without a world, name of its body."""
    seed: Annotated[int, Field(ge=0, lt=2**63)]
    """Seed of start pose and actuation noise."""
    goal: GoalName = "victim"
    """Name of the place that a drive leads to, by which the robot can be sent there."""
    outcome: Outcome | None = None
    """Outcome, given with ``ended`` only. found: the goal was reached in the last frame (tick of
    this message), and, if the run ends by report, the robot reported it. false_goal: the robot
    reported a goal wrongly. missed: it reached the goal and timed out without a report.
    not_here: it reported that the goal is not there. aborted: the episode was ended early, or no
    judge was present for the report.
    """
    judge: Judge | None = None
    """Judge of ``found``: the task (simulation: the victim is near and in view) or the operator."""
    right: bool | None = None
    """Whether ``not_here`` is right; None if unknown."""
    box: Box | None = None
    """Box of the goal in the last frame, if the operator has drawn it."""

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
