"""Commands of an operator: an answer to every report of the robot while a key or stick is held."""

import math
from collections import Counter
from collections.abc import Callable
from typing import Final

from schemas.base import NO_EPISODE, STANDING, Message, Source, Velocity
from schemas.command import Command, CommandApplied
from schemas.episode import Episode

#: Share of its nominal speed at which a car, which cannot turn on the spot, drives for a turn key
#: alone.
TURNS_AT: Final = 0.5
#: A person who held on for this long before an obstacle, and holds again this soon, insists.
STOOD_S = 1.0
AGAIN_S = 2.0
_NEVER: Final = math.inf, -math.inf


class Commands:
    """Commands of a person who drives; each method returns the command to send, if any.

    While a velocity is held, it answers every report of the robot; a change is sent at once. After
    the release one ``stop`` is sent, and then nothing, so that another driver can continue. An
    emergency stop repeats until the robot reports it, and ends when the robot is armed; a later
    emergency stop stays. A robot that reports that it cannot turn so sharply is a car: from then on
    a turn key alone also drives it ahead slowly. A person who has
    seen the robot stand before an obstacle and holds again insists: the robot continues slowly.

    ``robot`` is the robot's id, for commands before its first report. ``clock`` returns seconds.
    """

    def __init__(self, robot: str, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._held: Velocity | None = None
        self._until_s = 0.0
        #: The last report, or a placeholder before the first; emergency stops descend from it.
        self.heard = Message(robot=robot, episode=NO_EPISODE, tick=0, stamp_ns=0)
        #: The last report of the running episode; None without an episode.
        self.applied: CommandApplied | None = None
        self.episode: str | None = None
        self.last_ended: str | None = None
        #: Number of the latched stop as last reported; 0 without a stop, None before the first
        #: report.
        self.stop: int | None = None
        self.emergency = False  # Whether an emergency stop is requested.
        self._arming = False
        # Whether the robot turns only while driving, by its reports in this episode.
        self._car = False
        #: First and last time that the robot reported an obstacle while a key was held.
        self._stood_s = _NEVER
        self._insists = False
        self._sent: Velocity | None = None
        self._answered = -1
        self._sequences: Counter[Source] = Counter()

    @property
    def to_release(self) -> int | None:
        """Number of the stop to release, 0 without a stop; None while it is unknown."""
        return None if self.emergency and not self.stop else self.stop

    @property
    def held(self) -> Velocity | None:
        """The held velocity, if any."""
        if self._clock() >= self._until_s:
            self._held = None
        return self._held

    def handle(self, applied: CommandApplied) -> Command | None:
        """Answer a report of the robot."""
        if applied.episode == self.last_ended:
            return None  # The end of the episode, on another topic, has overtaken it.
        self._enter(applied.episode)
        if self.applied is None or applied.tick != self.applied.tick:
            self._sequences.clear()
        self.applied = self.heard = applied
        self.stop = applied.latched_stop
        self._car = self._car or applied.reason == "radius"
        if self.held is not None and applied.reason == "obstacle" and applied.linear == 0.0:
            now_s = self._clock()
            self._stood_s = min(self._stood_s[0], now_s), now_s
        if self.emergency:
            return self.repeat_stop()
        if self.held is not None and applied.tick != self._answered:
            return self._drive()
        return self.poll()

    def told(self, stop: int) -> Command | None:
        """Store the number of the stop that a robot reports without an episode."""
        self.stop = stop
        return self.repeat_stop()

    def hold(self, held: Velocity | None, until_s: float = 0.0) -> Command | None:
        """Hold a velocity until a time of the clock; None releases it."""
        if self.held is None and held is not None:
            first_s, last_s = self._stood_s
            self._insists = last_s - first_s >= STOOD_S and self._clock() - last_s <= AGAIN_S
            self._stood_s = _NEVER
        self._held = held
        self._until_s = until_s
        return self.poll()

    def poll(self) -> Command | None:
        """Return the command for a change of the held velocity, including its expiry."""
        return self._drive() if self.held != self._sent else None

    def stop_for_emergency(self) -> Command:
        """Stop until the robot is armed, even if arming was requested before."""
        self._held = self._sent = None
        self.emergency = True
        self._arming = False
        return self._command("emergency_stop", STANDING)

    def repeat_stop(self) -> Command | None:
        """Repeat an emergency stop until the robot reports it."""
        due = self.emergency and not self.stop and not self._arming
        return self._command("emergency_stop", STANDING) if due else None

    def arming(self) -> None:
        """Note that the robot is asked to release its stop."""
        self._arming = True

    def armed(self) -> None:
        """Note that the robot has released the stop; a later emergency stop stays."""
        if self._arming:
            self.emergency = False
            self.stop = 0

    def answered(self) -> None:
        """Note that the request has ended."""
        self._arming = False

    def on_event(self, event: Episode) -> None:
        """Follow the starts and ends of episodes."""
        if event.event == "started":
            self._enter(event.episode)
        elif event.event == "ended":
            self.last_ended = event.episode
            if event.episode == self.episode:
                self.no_episode()

    def no_episode(self) -> None:
        """Note that no episode runs."""
        self.applied = self._held = self._sent = None

    def _enter(self, episode: str) -> None:
        if episode != self.episode:
            self.episode = episode
            self._answered = -1
            self._car = False
            self._stood_s = _NEVER
            self.no_episode()

    def _drive(self) -> Command | None:
        if self.applied is None or self.emergency:
            return None
        self._sent = self.held
        self._answered = self.applied.tick
        return self._command("teleop", self._sent or STANDING)

    def _command(self, source: Source, velocity: Velocity) -> Command:
        linear, angular = velocity
        linear = TURNS_AT * abs(angular) if self._car and not linear else linear
        sequence = self._sequences[source]
        self._sequences[source] += 1
        insists = self._insists and source == "teleop" and self._sent is not None
        return Command.after(
            self.heard,
            source=source,
            sequence=sequence,
            linear=linear,
            angular=angular,
            insists=insists,
        )
