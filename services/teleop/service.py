"""From keys to commands: an answer to every heartbeat of the robot while a key is held, else silence."""

from __future__ import annotations

from collections import Counter

from schemas.base import Atom, Message, Source
from schemas.command import Command, CommandApplied
from schemas.episode import Episode
from services.teleop.keys import KeyHold


class TeleopService:
    """What a person at the keyboard tells the robot.

    While a key is held, every heartbeat is answered by its movement. A change between two heartbeats is sent at once,
    for the same frame. When the key is released one ``stop`` is sent, then nothing: another driver may go on.

    An emergency stop goes out at once, be there an episode or not, and is repeated until the robot says that it stands
    for it. It ends when the robot was armed.

    Parameters
    ----------
    keys
        Tells which movement is asked for.
    robot
        Whom an emergency stop is for before anything was heard of the robot.
    """

    def __init__(self, keys: KeyHold, robot: str) -> None:
        self._keys = keys
        #: What an emergency stop descends from: the last heartbeat; the actuator takes it whatever its episode.
        self._heard = Message(robot=robot, episode="none", tick=0, stamp_ns=0)
        self._arming = False
        self._sent: Atom | None = None
        self._answered = -1
        self._sequences: Counter[Source] = Counter()
        self._last_ended: str | None = None
        self.episode: str | None = None
        self.emergency = False
        #: Emergency stops that were asked for here.
        self.stops = 0
        self.applied: CommandApplied | None = None

    @property
    def heard(self) -> Message:
        """The last heartbeat, or what stands for one before the first."""
        return self._heard

    @property
    def held(self) -> Atom | None:
        """The movement whose key is held."""
        return self._keys.held()

    def handle(self, applied: CommandApplied) -> Command | None:
        """Answer a heartbeat."""
        if applied.episode == self._last_ended:
            return None  # Overtaken by the news of the end: it came on another topic.
        self._enter(applied.episode)
        if self.applied is None or applied.tick != self.applied.tick:
            self._sequences.clear()
        self.applied = self._heard = applied
        if self.emergency:
            return None if self._arming or applied.reason == "emergency_stop" else self._emergency()
        if self._keys.held() is not None and applied.tick != self._answered:
            return self._drive()
        return self.poll()

    def press(self, atom: Atom) -> Command | None:
        """Take a press or a repeat of a key that moves the robot or stops it."""
        self._keys.press(atom)
        return self.poll()

    def poll(self) -> Command | None:
        """Send a change of what is held, be it that time has released a key."""
        return self._drive() if self._keys.held() != self._sent else None

    def release(self, atom: Atom | None = None) -> Command | None:
        """Let go of a key, or of every key at once."""
        self._keys.release(atom)
        return self.poll()

    def stop_for_emergency(self) -> Command:
        """Stop, and stay so until the robot is armed, also where that has just been asked for."""
        self._keys.release()
        self._sent = None
        self.emergency = True
        self.stops += 1
        self._arming = False
        return self._emergency()

    def arming(self) -> None:
        """Take note that the robot is being asked to release its stop."""
        self._arming = True

    def armed(self, *, released: bool) -> None:
        """Take note of the answer; a stop that was pressed meanwhile stays."""
        if self._arming and released:
            self.emergency = False
        self._arming = False

    def on_event(self, event: Episode) -> None:
        """Follow the beginnings and ends of episodes."""
        if event.event == "started":
            self._enter(event.episode)
        elif event.event == "ended":
            self._last_ended = event.episode
            if event.episode == self.episode:
                self.applied = None
                self._keys.release()
                self._sent = None

    def _enter(self, episode: str) -> None:
        if episode == self.episode:
            return
        self.episode = episode
        self.applied = None
        self._answered = -1
        self._sent = None
        self._keys.release()

    def _drive(self) -> Command | None:
        held = self._keys.held()
        if self.applied is None or self.emergency:
            return None
        self._sent = held
        self._answered = self.applied.tick
        return self._command("teleop", held or "stop")

    def _emergency(self) -> Command:
        return self._command("emergency_stop", "stop")

    def _command(self, source: Source, atom: Atom) -> Command:
        command = Command.after(self._heard, source=source, sequence=self._sequences[source], atom=atom)
        self._sequences[source] += 1
        return command
