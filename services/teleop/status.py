"""What the operator is told: who drives, what the robot does, and how the episode goes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from schemas.base import Atom
from schemas.codec import printable
from schemas.command import CommandApplied, StopCause
from schemas.episode import Episode

#: The robot's heart beats ten times a second.
SILENCE_S: Final = 1.0
_STOPPED: Final[dict[StopCause | None, str]] = {
    "not_armed": "not armed",
    "operator_lost": "it had lost you; r resumes",
    "fault": "its body has failed",
}
_WAITS: Final[dict[StopCause | None, str]] = {
    None: "armed",
    "not_armed": "not armed",
    "emergency_stop": "emergency stop",
    "operator_lost": "not armed, it had lost its operator",
    "fault": "not armed, its body has failed",
}
NO_EPISODE: Final = "no episode; press n to begin one"


class Status:
    """Keeps the last of what was heard.

    Parameters
    ----------
    clock
        Monotonic seconds.
    say
        Writes a line above the status line.
    """

    def __init__(self, clock: Callable[[], float], say: Callable[[str], None]) -> None:
        self._clock = clock
        self.say = say
        self._applied: CommandApplied | None = None
        self._heard_s = 0.0
        self._waits = "-"
        self._last_ended: str | None = None
        self._episode = NO_EPISODE

    def on_applied(self, applied: CommandApplied) -> None:
        """Take the robot's heartbeat."""
        if applied.episode == self._last_ended:
            return  # Overtaken by the news of the end: it came on another topic.
        self._applied = applied
        self._heard_s = self._clock()

    def on_answer(self, cause: StopCause | None) -> None:
        """Take what the robot answers without an episode."""
        self._applied = None
        self._waits = _WAITS[cause]

    def on_silence(self) -> None:
        """Take note that it does not answer."""
        self._waits = "-"

    def on_request(self) -> None:
        """Take note that a new episode was asked for."""
        self._episode = "waiting for the robot (a simulator's first picture takes a while)"

    def on_failure(self) -> None:
        """Take note that it was refused."""
        self._episode = NO_EPISODE

    def on_event(self, event: Episode) -> None:
        """Take an episode's event, and say it in words."""
        what = event.event.replace("_", " ") if event.outcome is None else f"ended: {event.outcome}"
        self._episode = what if event.event != "started" else f"{event.driver} drives"
        if event.event == "ended":
            self._applied = None
            self._waits = "-"
            self._last_ended = event.episode
            self._episode = f"{what}; press n for the next one"
        self.say(f"frame {event.tick}: {what} ({event.purpose} in {printable(event.world)}, seed {event.seed})")

    def line(self, held: Atom | None, emergency: bool) -> str:
        """Return the status line."""
        parts = [self._robot(), f"you: {held or '-'}", self._episode]
        if emergency:
            parts.insert(0, "EMERGENCY STOP")
        return "  |  ".join(parts)

    def _robot(self) -> str:
        applied = self._applied
        if applied is None:
            return f"robot: {self._waits}"
        silent_s = self._clock() - self._heard_s
        if silent_s > SILENCE_S:
            return f"NO SIGN OF THE ROBOT for {silent_s:.0f} s"
        by = {
            "command": f"by {applied.source}",
            "silence": "nobody drives",
            "taken_over": "you have taken over; r resumes",
            "emergency_stop": _STOPPED.get(applied.stop_cause, "emergency stop"),
        }
        doing = f"{applied.atom} ({by[applied.reason]})"
        return f"frame {applied.tick}  |  robot: {doing}  |  refused {applied.refused}"
