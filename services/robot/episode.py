"""One episode: frame after frame, and how it ends. The one loop that services, experiments and Gymnasium share."""

from typing import Generic, Literal, TypeVar

from schemas.episode import Outcome
from schemas.rpc import ResetRequest
from services.robot.body import Body, View
from services.robot.task import Task

#: How a run ended; false_goal: the robot said that it was there, and was not.
RunOutcome = Outcome | Literal["false_goal"]
V = TypeVar("V", bound=View)


class Episode(Generic[V]):
    """One episode of a body; whoever drives it acts between one frame and the next.

    The request says the seed, the purpose, where to begin, and after how many frames the time is out, if ever. Raises
    ServiceError when the body cannot do that.
    """

    def __init__(self, body: Body[V], task: Task[V], request: ResetRequest) -> None:
        self.request = request
        self.beginning = body.begin(request)
        self.outcome: Outcome | None = None
        self._body = body
        self._task = task
        self._reached: bool | None = None
        self.tick = self._timed = 0
        self.view = body.look(0)

    @property
    def reached(self) -> bool:
        """Whether the last frame shows that the goal is reached; looked at once a frame."""
        if self._reached is None:
            self._reached = self._task.reached(self.view)
        return self._reached

    def next_frame(self, *, by_hand: bool = False) -> V:
        """Take the next frame, and set ``outcome`` if the episode ends with it.

        A collision counts before the goal. A search ends as soon as its goal is reached; a demonstration goes on until
        its driver has arrived, or the time is out. While a person has taken over, no time passes. Frame 0 ends nothing.
        """
        self.tick += 1
        self._timed += not by_hand
        self.view, self._reached = self._body.look(self.tick), None
        limit = self.request.max_ticks
        timed_out = limit is not None and not by_hand and self._timed >= limit
        if self.view.contact:
            self.outcome = "collision"
        # Whether the goal is reached is asked only where it matters: to look for a victim takes a picture more.
        elif (self.request.purpose == "run" or timed_out) and self.reached:
            self.outcome = "found"
        elif timed_out:
            self.outcome = "timeout"
        return self.view
