"""From what is held to commands: an answer to every heartbeat of the robot while anything is, else silence."""

import math
from collections import Counter
from collections.abc import Callable
from typing import Final

from schemas.base import NO_EPISODE, STANDING, Message, Source, Velocity
from schemas.command import Command, CommandApplied
from schemas.episode import Episode

#: How fast a car, which cannot turn on the spot, drives ahead by a turn key alone: of its nominal speed.
TURNS_AT: Final = 0.5
#: Who has held on for so long while the robot stood before something has seen it, and insists by holding again so soon.
STOOD_S = 1.0
AGAIN_S = 2.0
_NEVER: Final = math.inf, -math.inf


class Commands:
    """What a person who drives tells the robot; each method returns the command that is to be sent, if any.

    While a velocity is held, by keys or a stick, every heartbeat is answered by it; a change is sent at once. When
    nothing is held any more one ``stop`` is sent, then nothing: another driver may go on. An emergency stop is repeated
    until the robot says that it stands, and ends when it was armed; one that is pressed after that was asked for stays.
    A robot that cannot turn so sharply tells so, and is a car: from then on a turn key drives it ahead, slowly, in as
    narrow a bend as its gate lets it, unless it is told at once to drive on. Who has seen the robot stand before
    something and holds again insists: it goes on, slowly.

    ``robot`` is whom it is for before anything was heard of the robot; ``clock`` gives seconds.
    """

    def __init__(self, robot: str, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._held: Velocity | None = None
        self._until_s = 0.0
        #: The last heartbeat, or what stands for one before the first: an emergency stop descends from it.
        self.heard = Message(robot=robot, episode=NO_EPISODE, tick=0, stamp_ns=0)
        #: The last heartbeat of the running episode; None where there is none.
        self.applied: CommandApplied | None = None
        self.episode: str | None = None
        self.last_ended: str | None = None
        #: Number of the stop that the robot stands for, as it last told; 0 where none is, None before it told anything.
        self.stop: int | None = None
        self.emergency = False  # Whether an emergency stop is asked for.
        self._arming = False
        self._car = (
            False  # Whether it turns only in driving, as far as it has told in this episode.
        )
        #: When the robot first and last told, while something was held, that it stands before something.
        self._stood_s = _NEVER
        self._insists = False
        self._sent: Velocity | None = None
        self._answered = -1
        self._sequences: Counter[Source] = Counter()

    @property
    def to_release(self) -> int | None:
        """Number of the stop that the operator knows of, 0 where none is; None while they cannot know of theirs."""
        return None if self.emergency and not self.stop else self.stop

    @property
    def held(self) -> Velocity | None:
        """What is held."""
        if self._clock() >= self._until_s:
            self._held = None
        return self._held

    def handle(self, applied: CommandApplied) -> Command | None:
        """Answer a heartbeat."""
        if applied.episode == self.last_ended:
            return None  # overtaken by the news of the end, which came on another topic
        self._enter(applied.episode)
        if self.applied is None or applied.tick != self.applied.tick:
            self._sequences.clear()
        self.applied = self.heard = applied
        self.stop = applied.emergency_stop
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
        """Take the number of the stop that a robot without an episode tells."""
        self.stop = stop
        return self.repeat_stop()

    def hold(self, held: Velocity | None, until_s: float = 0.0) -> Command | None:
        """Take what is held now, until a time of the clock; None where nothing is."""
        if self.held is None and held is not None:
            first_s, last_s = self._stood_s
            self._insists = last_s - first_s >= STOOD_S and self._clock() - last_s <= AGAIN_S
            self._stood_s = _NEVER
        self._held = held
        self._until_s = until_s
        return self.poll()

    def poll(self) -> Command | None:
        """Send a change of what is held, be it that time has released it."""
        return self._drive() if self.held != self._sent else None

    def stop_for_emergency(self) -> Command:
        """Stop, and stay so until the robot is armed, also where that has just been asked for."""
        self._held = self._sent = None
        self.emergency = True
        self._arming = False
        return self._command("emergency_stop", STANDING)

    def repeat_stop(self) -> Command | None:
        """Repeat an emergency stop of which the robot has not told that it stands for it."""
        due = self.emergency and not self.stop and not self._arming
        return self._command("emergency_stop", STANDING) if due else None

    def arming(self) -> None:
        """Take note that the robot is being asked to release its stop."""
        self._arming = True

    def armed(self) -> None:
        """Take note that it has released the stop; one that was pressed meanwhile stays."""
        if self._arming:
            self.emergency = False
            self.stop = 0

    def answered(self) -> None:
        """Take note that it is no longer being asked."""
        self._arming = False

    def on_event(self, event: Episode) -> None:
        """Follow the beginnings and ends of episodes."""
        if event.event == "started":
            self._enter(event.episode)
        elif event.event == "ended":
            self.last_ended = event.episode
            if event.episode == self.episode:
                self.no_episode()

    def no_episode(self) -> None:
        """Take note that there is none, or none any more."""
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
