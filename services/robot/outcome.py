"""When an episode ends, and how: one rule for the service and for searches without messages."""

from __future__ import annotations

from typing import Literal

from schemas.episode import Outcome, Purpose

#: How a run ended; false_goal: the robot said that it was there, and was not.
RunOutcome = Outcome | Literal["false_goal"]


def outcome_of(*, collided: bool, in_view: bool, purpose: Purpose, timed_out: bool) -> Outcome | None:
    """Say how the episode ends with a frame, or None where it goes on.

    A collision counts before the victim. A search ends as soon as the victim is near and in view; a demonstration goes
    on until its driver has arrived, or the time is out.

    Parameters
    ----------
    collided
        Whether the robot has touched anything.
    in_view
        Whether this frame shows the victim, near.
    purpose
        Of the episode.
    timed_out
        Whether it may have no more frames.
    """
    if collided:
        return "collision"
    if in_view and (purpose == "run" or timed_out):
        return "found"
    return "timeout" if timed_out else None
