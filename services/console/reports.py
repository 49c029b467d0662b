"""What is heard of the robot, put on the board."""

from __future__ import annotations

from collections import deque
from typing import Final

from schemas.codec import printable
from schemas.command import CommandApplied, StopCause
from schemas.episode import Episode
from services.console.newest_content import Board

#: Lines of news that the page keeps.
_LINES: Final = 30


class BoardReports:
    """Reports to whoever looks at the board; of one thread.

    Parameters
    ----------
    board
        Where the channels ``robot`` and ``news`` are.
    """

    def __init__(self, board: Board) -> None:
        self._board = board
        self._lines: deque[dict[str, object]] = deque(maxlen=_LINES)
        self._said = 0
        self._ended: str | None = None
        #: The ``robot`` channel.
        self.robot: dict[str, object] = {"episode": None, "answers": False, "waiting": False, "emergency": False}
        self._tell()

    def _tell(self, **news: object) -> None:
        self.robot |= news | {"at": round(self._board.clock(), 3)}
        self._board.put("robot", self.robot)

    def say(self, text: str) -> None:
        """Tell one thing, once."""
        self._said += 1
        self._lines.append({"number": self._said, "at": round(self._board.clock(), 3), "text": printable(text)})
        self._board.put("news", list(self._lines))

    def emergency(self, *, pressed: bool) -> None:
        """Tell whether an emergency stop is asked for."""
        if pressed != self.robot["emergency"]:
            self._tell(emergency=pressed)

    def on_applied(self, applied: CommandApplied) -> None:
        """Take the robot's heartbeat."""
        if applied.episode == self._ended:
            return  # Overtaken by the news of the end: it came on another topic.
        if applied.episode != self.robot["episode"]:
            # It began before this process did, and nobody has told how.
            self._tell(purpose=None, driver=None, goal=None, world=None, outcome=None)
        self._tell(
            answers=True,
            waiting=False,
            episode=applied.episode,
            tick=applied.tick,
            atom=applied.atom,
            source=applied.source,
            reason=applied.reason,
            stop=applied.emergency_stop,
            cause=applied.stop_cause,
            refused=applied.refused,
        )

    def on_event(self, event: Episode) -> None:
        """Follow the episode."""
        told = {"purpose": event.purpose, "driver": event.driver, "goal": event.goal, "world": event.world}
        if event.event == "ended":
            self._ended = event.episode
            self._tell(**told, episode=None, tick=event.tick, outcome=event.outcome, judge=event.judge)
            self.say(f"{_named(event)}: {event.outcome} after {event.tick} frames")
        elif event.event == "started":
            self._tell(**told, episode=event.episode, tick=0, outcome=None, waiting=False)
        else:
            self.say(f"{_named(event)}, frame {event.tick}: {event.event.replace('_', ' ')}")

    def on_request(self) -> None:
        """Take note that a new episode was asked for."""
        self._tell(waiting=True)

    def on_failure(self) -> None:
        """Take note that it was refused."""
        self._tell(waiting=False)

    def on_answer(self, cause: StopCause | None) -> None:
        """Take why the robot stands that has no episode; None where it is armed."""
        self._tell(answers=True, episode=None, cause=cause)

    def on_silence(self) -> None:
        """Take note that it does not answer."""
        self._tell(answers=False)


def _named(event: Episode) -> str:
    return f"{'Run' if event.purpose == 'run' else 'Drive'} to {event.goal}"
