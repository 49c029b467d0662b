"""One episode: frame after frame, and what ends it. The one loop that services, experiments and Gymnasium share.

What ends an episode is all here. A frame does (`RunningEpisode.next_frame`): a collision, the goal of a run, the time.
A word does (`RunningEpisode.end`): of the operator, or of the robot that it is found or not here, which the planner
says (`smal.planning.Planner.said`), the policy tells (`schemas.action.Action.says`), and who began the run passes on
(`services.cli.episodes.client`, the console's `Operator.end_mine`). Who begins another or is gone ends it, too.
"""

from typing import Generic, NamedTuple, TypeVar

from schemas.episode import Box, Judge, Outcome, Said
from schemas.rpc import ResetRequest
from services.robot.body import Body, View
from services.robot.task import Task

V = TypeVar("V", bound=View)


class Ended(NamedTuple):
    """How an episode ended, as `schemas.episode.Episode` tells it."""

    outcome: Outcome
    judge: Judge | None = None
    right: bool | None = None
    box: Box | None = None


class RunningEpisode(Generic[V]):
    """One episode of a body, which drives between one frame and the next; ServiceError when it cannot do as asked."""

    def __init__(self, body: Body[V], task: Task[V], request: ResetRequest) -> None:
        self.request = request
        self.beginning = body.begin(request)
        self.outcome: Outcome | None = None
        self._body = body
        self._task = task
        self._reached: bool | None = None
        self.passed = False  # Whether a run has reached its goal in some frame.
        self.tick = self._timed = 0
        self.view = body.look(0)

    @property
    def reached(self) -> bool:
        """Whether the last frame shows that the goal is reached; looked at once a frame."""
        if self._reached is None:
            self._reached = self._task.reached(self.view, self.request.goal)
        return self._reached

    def next_frame(self, *, by_hand: bool = False) -> V:
        """Take the next frame, and set ``outcome`` if the episode ends with it.

        A collision counts before the goal. A run ends as soon as its goal is reached, or, `until_said`, by `end`; a
        drive goes on until its driver has arrived, or the time is out. While a person has taken over, no time passes.
        Frame 0 ends nothing.
        """
        self.tick += 1
        self._timed += not by_hand
        self.view = self._body.look(self.tick)
        self._reached = None
        limit = self.request.max_ticks
        timed_out = limit is not None and not by_hand and self._timed >= limit
        if self.view.contact:
            self.outcome = "collision"
        # Whether the goal is reached is asked only where it matters: to look for a victim takes a picture more.
        elif (self.request.purpose == "run" or timed_out) and self.reached:
            self.passed = True
            self.outcome = None if self.request.until_said else "found"
        if timed_out and self.outcome is None:
            self.outcome = "missed" if self.passed else "timeout"
        return self.view

    def end(self, said: Said | None = None, *, told: bool = False) -> Ended:
        """End with what the robot says, which the task judges; without a word; or as the operator told that it found.

        Where nobody can judge, or nobody has said anything, it is found if the last frame shows it, and else aborted.
        """
        if told and not self.reached:
            self._task.told(self.view, self.request.goal)
        gone = None if said is None else self._task.gone(self.view, self.request.goal)
        if said == "not_here":
            return Ended("not_here", right=gone)
        if told or self.reached:
            return Ended("found", "operator" if told else "task")
        return Ended("aborted" if gone is None else "false_goal")
