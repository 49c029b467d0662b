"""The last check before the wheels: which command the actuator obeys, if any.

Everything is judged on the actuator's own clock. A command names the frame (tick) that it descends from, and the gate
remembers when it captured that frame; so neither a wrong clock in another process, nor a clock that jumps, nor a
process that was frozen and wakes with old plans can make an old command look fresh.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace
from typing import Final, Literal

from schemas.base import Atom, Source
from schemas.command import Command

#: Age at which a command is no longer obeyed, seconds since the capture of the frame that it descends from. The robot
#: must stand 0.5 s after the last command; the rest is for braking from 2 m/s (0.25 s).
MAX_AGE_S: Final = 0.25
Refusal = Literal["wrong episode", "not the driver", "not finite", "unknown frame", "stale", "out of order"]
Reason = Literal["command", "silence", "taken_over", "emergency_stop"]


@dataclass(frozen=True)
class Applied:
    """What the actuator does now, and which frame's command made it do so."""

    atom: Atom
    speed: float
    source: Source | None
    reason: Reason
    answered_tick: int | None = None


@dataclass(frozen=True)
class _Accepted:
    command: Command
    captured_s: float


class CommandGate:
    """Arbitrates between the sources of commands for one robot.

    Parameters
    ----------
    max_age_s
        Age at which a command expires, counted from the capture of its frame; silence therefore means stop within
        this time of the last frame that was answered.
    """

    def __init__(self, max_age_s: float = MAX_AGE_S) -> None:
        self.max_age_s = max_age_s
        self._stops = self._released = 0
        self._begin("", "policy")

    @property
    def emergency_stop(self) -> int:
        """Number of the latched emergency stop, counted from 1 since the start; 0 where none is."""
        return self._stops if self._stops > self._released else 0

    @property
    def taken_over(self) -> bool:
        """Whether a person has taken over from the driver."""
        return self._taken_over

    def stop(self) -> None:
        """Latch an emergency stop; may be called on another thread than everything else."""
        self._stops += 1

    def begin(self, episode: str, driver: Source, *, release_stop: int = 0) -> None:
        """Start an episode: forget every command and name the driver.

        An emergency stop stays unless its number is given: whoever releases one does not release another that came
        meanwhile.
        """
        self._begin(episode, driver)
        stops = self._stops  # read once: another one may come meanwhile
        if release_stop == stops:
            self._released = stops

    def _begin(self, episode: str, driver: Source) -> None:
        self._episode = episode
        self._driver = driver
        self._taken_over = False
        self._captured_s: dict[int, float] = {}
        self._latest: dict[Source, _Accepted] = {}
        self.refused: Counter[Refusal] = Counter()

    def resume(self, episode: str, tick: int) -> bool:
        """Let the driver go on after a person had taken over; what was asked for before no longer counts.

        Parameters
        ----------
        episode, tick
            The newest frame that the person had heard of.

        Returns
        -------
        bool
            False where nothing was resumed: another episode has begun, or the person has commanded since.
        """
        mine = self._latest.get("teleop")
        if episode != self._episode or (mine is not None and mine.command.tick > tick):
            return False
        self._taken_over = False
        # Their order goes on to count: a command that comes twice is refused.
        self._latest = {source: replace(one, captured_s=-math.inf) for source, one in self._latest.items()}
        return True

    def captured(self, tick: int, now_s: float) -> None:
        """Remember when a frame was captured; older frames than any fresh command may name are forgotten."""
        self._captured_s = {t: at for t, at in self._captured_s.items() if now_s - at <= self.max_age_s}
        self._captured_s[tick] = now_s

    def offer(self, command: Command, now_s: float) -> Refusal | None:
        """Take a command, or say why not.

        An emergency stop is taken whatever its age, order and episode, and without an episode too: it can only make
        the robot stand. It stays until ``begin`` is told to release it. A person's command takes over from any other
        driver, for good: where the person falls silent the robot stands until ``resume``.
        """
        refusal = self._check(command, now_s)
        if refusal is not None:
            self.refused[refusal] += 1
            return refusal
        if command.source == "emergency_stop":
            self.stop()
            return None
        if command.source != self._driver:
            self._taken_over = True
        self._latest[command.source] = _Accepted(command, self._captured_s[command.tick])
        return None

    def _check(self, command: Command, now_s: float) -> Refusal | None:
        if command.source == "emergency_stop":
            return None
        if command.episode != self._episode:
            return "wrong episode"
        if command.source not in ("teleop", self._driver):
            return "not the driver"
        if not 0.0 <= command.speed <= 1.0:  # NaN is not between them either
            return "not finite"
        last = self._latest.get(command.source)
        if last is not None and (command.tick, command.sequence) <= (last.command.tick, last.command.sequence):
            return "out of order"
        captured_s = self._captured_s.get(command.tick)
        if captured_s is None:
            # Either forgotten because it is too old, or never captured at all.
            return "stale" if self._captured_s and command.tick < min(self._captured_s) else "unknown frame"
        return "stale" if now_s - captured_s > self.max_age_s else None

    def answered(self, source: Source, tick: int) -> bool:
        """Whether a source has commanded for this very frame."""
        latest = self._latest.get(source)
        return latest is not None and latest.command.tick == tick

    def applied(self, now_s: float) -> Applied:
        """Return what the actuator has to do now: the fresh command of whoever drives, or stand."""
        if self.emergency_stop:
            return Applied("stop", 0.0, "emergency_stop", "emergency_stop")
        source: Source = "teleop" if self._taken_over else self._driver
        latest = self._latest.get(source)
        if latest is not None and now_s - latest.captured_s <= self.max_age_s:
            command = latest.command
            return Applied(command.atom, command.speed, source, "command", command.tick)
        return Applied("stop", 0.0, None, "taken_over" if self._taken_over else "silence")
