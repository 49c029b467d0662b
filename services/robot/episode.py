"""An episode: its frames and its end, shared by services, experiments and Gymnasium.

A frame ends an episode (`RunningEpisode.next_frame`) by a collision, the goal of a run, or the
timeout. A report ends it (`RunningEpisode.end`): the operator's, or the robot's that it has found
the goal or that the goal is not here. The planner decides on the report
(`smal.planning.Planner.said`), the policy publishes it (`schemas.action.Action.says`), and the
client that began the run passes it on (`services.cli.episodes.client`, the console's
`Operator.end_mine`). An episode also ends when another begins or its client is gone.
"""

from typing import Generic, NamedTuple, TypeVar

from schemas.episode import Box, Judge, Outcome, Said
from schemas.rpc import ResetRequest
from services.robot.body import Body, View, check_conditions
from services.robot.task import Task

V = TypeVar("V", bound=View)


class Ended(NamedTuple):
    """Outcome of an episode, as in `schemas.episode.Episode`."""

    outcome: Outcome
    judge: Judge | None = None
    right: bool | None = None
    box: Box | None = None


class RunningEpisode(Generic[V]):
    """An episode of a body, which drives between two frames; ServiceError if it cannot begin."""

    def __init__(self, body: Body[V], task: Task[V], request: ResetRequest) -> None:
        check_conditions(body, request)
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
        """Whether the last frame shows the goal; evaluated once per frame."""
        if self._reached is None:
            self._reached = self._task.reached(self.view, self.request.goal)
        return self._reached

    def next_frame(self, *, untimed: bool = False) -> V:
        """Take the next frame, and set ``outcome`` if the episode ends with it.

        A collision precedes the goal. A run ends as soon as its goal is reached or, with
        `until_said`, by `end`. A drive continues until its driver has arrived, or until the
        timeout. The time stands while a person has taken over, and while a stop is
        latched (``untimed``). Frame 0 ends nothing.
        """
        self.tick += 1
        self._timed += not untimed
        self.view = self._body.look(self.tick)
        self._reached = None
        limit = self.request.max_ticks
        timed_out = limit is not None and not untimed and self._timed >= limit
        if self.view.contact:
            self.outcome = "collision"
        # The check for the goal renders another image, so it runs only when it matters.
        elif (self.request.purpose == "run" or timed_out) and self.reached:
            self.passed = True
            self.outcome = None if self.request.until_said else "found"
        if timed_out and self.outcome is None:
            self.outcome = "missed" if self.passed else "timeout"
        return self.view

    def end(self, said: Said | None = None, *, told: bool = False) -> Ended:
        """End by the robot's report, by the operator's confirmation, or by neither.

        Without a judge or a report the outcome is found if the last frame shows the goal, and
        otherwise aborted. A run `until_said` that has reached its goal without a report is missed.
        """
        if told and not self.reached:
            self._task.told(self.view, self.request.goal)
        gone = None if said is None else self._task.gone(self.view, self.request.goal)
        if said == "not_here":
            return Ended("not_here", right=gone)
        silent = self.request.until_said and said is None and not told
        if silent and (self.passed or self.reached):
            return Ended("missed")
        if told or self.reached:
            return Ended("found", "operator" if told else "task")
        return Ended("aborted" if gone is None else "false_goal")
