"""One session at the keyboard: the terminal on one side, the robot on the other."""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from itertools import count
from queue import Empty, SimpleQueue
from typing import Final

from schemas import topics
from schemas.base import ATOMS
from schemas.command import CommandApplied
from schemas.episode import Episode
from schemas.heartbeat import Heartbeat
from schemas.rpc import ArmRequest, EndRequest, Nothing, ResetReply, ResetRequest, ResumeRequest, Status
from services.kit.bus import RpcError
from services.kit.node import Node
from services.teleop.config import TeleopSettings
from services.teleop.keys import Key, KeyEvent, KeyHold, KeyParser, News
from services.teleop.service import TeleopService
from services.teleop.status import Status as StatusLine
from services.teleop.terminal import Terminal, open_terminal

#: How often keys are read, releases noticed and the status line drawn.
POLL_S: Final = 0.02
#: How often the robot hears that the operator is there; it misses them after five times that.
BEAT_S: Final = 0.05
CONNECT_S: Final = 3.0
#: A simulator's first frame takes seconds.
RESET_S: Final = 60.0
ANSWER_S: Final = 5.0
HELP: Final = (
    "arrows or w a s d: drive (hold)   space: stop   e: EMERGENCY STOP   n: new episode   f: found, end it   "
    "r: resume   q: quit"
)
NO_RELEASES: Final = (
    "this terminal does not tell when a key is let go (kitty, foot, ghostty, WezTerm and others do): the robot goes on "
    "for up to {:g} s after a tap; space stops it at once"
)
#: How long a terminal may take to say that it tells releases.
TELLS_S: Final = 1.0


def run(settings: TeleopSettings) -> None:
    """Drive until the operator quits or the process is told to stop."""
    with Node("teleop", settings, CONNECT_S) as node, open_terminal() as terminal:
        node.stop_on_signals()
        session = TeleopSession(node, terminal, settings)
        terminal.say(HELP)
        node.spin()
        session.finish()


class TeleopSession:
    """Wires keys, commands and status line to a node; everything happens on the node's thread.

    Parameters
    ----------
    node
        Where to publish.
    terminal
        Where the operator sits.
    settings
        Seed and timing of keys.
    clock
        Monotonic seconds.
    """

    def __init__(
        self,
        node: Node,
        terminal: Terminal,
        settings: TeleopSettings,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._node = node
        self._terminal = terminal
        self._clock = clock
        self._parser = KeyParser()
        self._service = TeleopService(KeyHold(clock, settings.first_hold_s, settings.repeat_hold_s), node.robot)
        self._status = StatusLine(clock)
        self._seed = secrets.randbelow(2**31) if settings.seed is None else settings.seed
        self._goal = settings.goal
        self._mine: str | None = None
        self._first_hold_s = settings.first_hold_s
        self._tells_by_s: float | None = clock() + TELLS_S
        self._beats = count()
        # One question to the robot at a time, in a thread of its own: an emergency stop must not wait for its answer.
        self._asking: threading.Thread | None = None
        self._answers: SimpleQueue[Callable[[], None]] = SimpleQueue()
        node.subscribe(topics.APPLIED, self.on_applied)
        node.subscribe(topics.EPISODE, self.on_event)
        node.every(POLL_S, self.poll)
        node.every(BEAT_S, self._beat)
        self._beat()

    def on_applied(self, applied: CommandApplied) -> None:
        """Answer the robot's heartbeat."""
        self._node.publish(self._service.handle(applied))
        self._status.on_applied(applied)

    def on_event(self, event: Episode) -> None:
        """Follow the episode."""
        self._service.on_event(event)
        self._terminal.say(self._status.on_event(event))
        if event.event == "ended" and event.episode == self._mine:
            self._mine = None

    def poll(self) -> None:
        """Read the keys, notice releases and answers, and draw the status line."""
        typed = self._terminal.read()
        if typed is None:
            self._node.stop()
            return
        for event in self._parser.feed(typed):
            self._take(event)
        self._node.publish(self._service.poll())
        self._take_answer()
        if self._tells_by_s is not None and self._clock() > self._tells_by_s:
            self._tells_by_s = None
            self._terminal.say(NO_RELEASES.format(self._first_hold_s))
        self._terminal.show(self._status.line(self._service.held, self._service.emergency))

    def finish(self) -> None:
        """Stop the robot, and end the episode that was begun here, so that its recording is complete."""
        self._node.publish(self._service.release())
        if self._asking is not None:
            self._terminal.say("waiting for the robot's answer, to end what was begun")
            self._asking.join(RESET_S)
            self._take_answer()
        if self._mine is not None:
            try:
                self._node.bus.call("robot", "end", EndRequest(episode=self._mine), Nothing, ANSWER_S)
            except RpcError as error:
                self._terminal.say(str(error))
        self._beat(present=False)

    def _beat(self, *, present: bool = True) -> None:
        """Tell the robot that the operator is there, or leaves."""
        beat = Heartbeat.after(
            self._service.heard, session=self._node.session, sequence=next(self._beats), operator=True, present=present
        )
        self._node.publish(beat)

    def _take(self, event: KeyEvent) -> None:
        key, released = event
        if key == "tells_releases":
            self._tells_by_s = None
        elif key == "focus_lost":
            self._node.publish(self._service.release())
        elif key in ATOMS:
            self._node.publish(self._service.release(key) if released else self._service.press(key))
        elif not released:
            self._press(key)

    def _press(self, key: Key | News) -> None:
        if key == "quit":
            self._node.stop()
        elif key == "new_episode":
            self._begin_episode()
        elif key == "resume":
            self._resume()
        elif key == "found":
            self._found()
        elif key == "emergency_stop":
            self._node.publish(self._service.stop_for_emergency())
            self._terminal.say("EMERGENCY STOP until you begin a new episode (n) or resume (r)")

    def _begin_episode(self) -> None:
        """Arm the robot if it has to be, and ask for an episode."""
        request = ResetRequest(
            session=self._node.session,
            seed=self._seed,
            purpose="drive",
            goal=self._goal,
            driver="teleop",
            mode="realtime",
        )
        armed = self._arming()

        def ask() -> Callable[[], None]:
            armed()
            reply = self._node.bus.call("robot", "reset", request, ResetReply, RESET_S)
            return lambda: setattr(self, "_mine", reply.episode)

        if self._ask(ask, self._status.on_failure):
            self._seed += 1
            self._terminal.say(f"new episode, seed {request.seed} ...")
            self._status.on_request()

    def _resume(self) -> None:
        """Arm the robot if it has to be, and have the driver go on from whom the operator has taken over."""
        if self._service.episode is None or self._service.held is not None:
            self._terminal.say("no episode" if self._service.held is None else "let go of the key first")
            return
        episode, tick = self._service.episode, self._service.heard.tick
        request = ResumeRequest(episode=episode, tick=tick, session=self._node.session)
        armed = self._arming()

        def ask() -> Callable[[], None]:
            armed()
            self._node.bus.call("robot", "resume", request, Nothing, ANSWER_S)
            return lambda: None

        self._ask(ask)

    def _found(self) -> None:
        """End the episode at its goal, because the operator says so."""
        if self._service.applied is None or self._service.episode is None:
            self._terminal.say("no episode to end")
            return
        request = EndRequest(episode=self._service.episode, found=True, session=self._node.session)
        self._node.publish(self._service.release())

        def ask() -> Callable[[], None]:
            self._node.bus.call("robot", "end", request, Nothing, ANSWER_S)
            return lambda: None

        self._ask(ask)

    def _arming(self) -> Callable[[], None]:
        """Return what releases the stop that the operator knows of when they press the key, and no other one.

        Heartbeats tell its number; without an episode there are none, and nothing that moves.
        """
        seen = None if self._service.applied is None else self._service.applied.emergency_stop
        stops = self._service.stops
        call = self._node.bus.call

        def arm() -> None:
            stop = seen
            if stop is None:
                status = call("robot", "status", Nothing(), Status, ANSWER_S)
                stop = int(status.detail.get("emergency_stop") or 0)
            if self._service.stops != stops:
                raise RpcError("an emergency stop came meanwhile; press the key again to release it")
            if stop:
                call("robot", "arm", ArmRequest(stop=stop, session=self._node.session), Nothing, ANSWER_S)
            self._answers.put(lambda: self._service.armed(released=True))

        return arm

    def _ask(self, question: Callable[[], Callable[[], None]], failed: Callable[[], None] = lambda: None) -> bool:
        """Ask the robot something; what it returns, or says why not, is done on the node's thread."""
        if self._asking is not None:
            self._terminal.say("still waiting for the robot")
            return False
        self._service.arming()

        def refused(reason: str) -> None:
            self._terminal.say(reason)
            failed()

        def answered() -> None:
            self._service.armed(released=False)
            self._asking = None

        def ask() -> None:
            try:
                done = question()
            except Exception as error:  # noqa: BLE001 - else nothing could ever be asked again
                reason = str(error)
                self._answers.put(lambda: refused(reason))
            else:
                self._answers.put(done)
            self._answers.put(answered)

        self._asking = threading.Thread(target=ask, name="question", daemon=True)
        self._asking.start()
        return True

    def _take_answer(self) -> None:
        with suppress(Empty):
            while True:
                self._answers.get_nowait()()
