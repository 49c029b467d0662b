"""One session at the keyboard: the terminal on one side, the robot on the other."""

from __future__ import annotations

import math
import secrets
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from itertools import count
from queue import Empty, SimpleQueue
from typing import Final, cast

from schemas import topics
from schemas.base import ATOMS, Strict
from schemas.command import CommandApplied, StopCause
from schemas.episode import Episode
from schemas.heartbeat import Heartbeat
from schemas.rpc import ArmRequest, EndRequest, Nothing, ResetReply, ResetRequest, ResumeRequest, Status
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
#: How often the robot is asked how it is, where it does not tell by its heartbeat, which beats ten times a second.
ASK_S: Final = 0.5
HELP: Final = (
    "arrows or w a s d: drive (hold)   space: stop   e: EMERGENCY STOP   n: new episode   f: found, end it   "
    "r: arm, resume   q: quit"
)
NO_RELEASES: Final = (
    "this terminal does not tell when a key is let go (kitty, foot, ghostty, WezTerm and others do): the robot goes on "
    "for up to {:g} s after a tap; space stops it at once"
)
#: How long a terminal may take to say that it tells releases.
TELLS_S: Final = 1.0


def run(settings: TeleopSettings) -> None:
    """Drive until the operator quits or the process is told to stop."""
    with Node("teleop", settings, CONNECT_S) as node:
        node.stop_on_signals()
        with open_terminal() as terminal:
            terminal.say(HELP)
            session = TeleopSession(node, terminal, settings)
            try:
                node.spin()
            finally:
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
        self._heard_s = -math.inf
        self._inquiring = False
        # One question to the robot at a time, in a thread of its own: an emergency stop must not wait for its answer.
        self._asking: threading.Thread | None = None
        self._leaving = False
        self._answers: SimpleQueue[Callable[[], None]] = SimpleQueue()
        node.subscribe(topics.APPLIED, self.on_applied)
        node.subscribe(topics.EPISODE, self.on_event)
        node.every(POLL_S, self.poll)
        node.every(BEAT_S, self._beat)
        node.every(ASK_S, self._inquire)
        self._beat()
        self._inquire()

    def on_applied(self, applied: CommandApplied) -> None:
        """Answer the robot's heartbeat."""
        self._heard_s = self._clock()
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
        for event in self._parser.feed(typed or b""):
            self._take(event)
        self._node.publish(self._service.poll())
        self._take_answers()
        if self._tells_by_s is not None and self._clock() > self._tells_by_s:
            self._tells_by_s = None
            self._terminal.say(NO_RELEASES.format(self._first_hold_s))
        self._terminal.show(self._status.line(self._service.held, self._service.emergency))

    def finish(self) -> None:
        """Stop the robot, end the episode that was begun here, so that its recording is complete, and say good-bye."""
        self._node.publish(self._service.release())
        self._leaving = True
        if self._asking is not None:
            self._terminal.say("waiting for the robot's answer, to end what was begun")
            self._wait(RESET_S)
        if self._mine is not None:
            request = EndRequest(episode=self._mine)
            self._ask(lambda: self._call("end", request))
            self._wait(ANSWER_S)
        self._beat(present=False)

    def _wait(self, timeout_s: float) -> None:
        """Wait for an answer. The operator is still there: they are not missed, and an emergency stop is heard."""
        until_s = self._clock() + timeout_s
        while self._asking is not None and self._clock() < until_s:
            self._beat()
            self._node.drain()
            self.poll()
            time.sleep(POLL_S)

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
            self._terminal.tells_releases = True
        elif key == "focus_lost":
            self._node.publish(self._service.release())
        elif key in ATOMS and released:
            self._node.publish(self._service.release(key))
        elif not released:
            self._press(key)

    def _press(self, key: Key | News) -> None:
        if key == "emergency_stop":
            if not self._service.emergency:
                self._terminal.say("EMERGENCY STOP until you begin a new episode (n) or resume (r)")
            self._node.publish(self._service.stop_for_emergency())
        elif self._leaving:
            return
        elif key in ATOMS:
            self._node.publish(self._service.press(key))
        elif key == "quit":
            self._node.stop()
        elif key == "new_episode":
            self._begin_episode()
        elif key == "resume":
            self._resume()
        elif key == "found":
            self._found()

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
        arm = self._arming()
        if arm is None:
            return

        def ask() -> Callable[[], None]:
            arm()
            reply = self._node.bus.call("robot", "reset", request, ResetReply, RESET_S)
            return lambda: self._begun(reply.episode)

        self._seed += 1
        self._terminal.say(f"new episode, seed {request.seed} ...")
        self._status.on_request()
        self._ask(ask, self._status.on_failure)

    def _begun(self, episode: str) -> None:
        if episode != self._service.last_ended:
            self._mine = episode

    def _resume(self) -> None:
        """Arm the robot if it has to be, and have whoever the operator has taken over from go on, or begin the next."""
        if self._service.held is not None:
            self._terminal.say("let go of the key first")
            return
        heard = self._service.heard
        request = ResumeRequest(episode=heard.episode, tick=heard.tick, session=self._node.session)
        arm = self._arming()
        if arm is None:
            return

        def ask() -> Callable[[], None]:
            arm()
            if self._node.bus.call("robot", "status", Nothing(), Status, ANSWER_S).detail["taken_over"]:
                return self._call("resume", request)
            return lambda: self._terminal.say("the robot is armed")

        self._ask(ask)

    def _found(self) -> None:
        """End the episode at its goal, because the operator says so."""
        applied = self._service.applied
        if applied is None:
            self._terminal.say("no episode to end")
        elif self._may_ask():
            self._node.publish(self._service.release())
            request = EndRequest(episode=applied.episode, found=True, session=self._node.session)
            self._ask(lambda: self._call("end", request))

    def _arming(self) -> Callable[[], None] | None:
        """Return what releases the stop that the operator knows of when they press the key, and no other one.

        None where the robot may not be asked, which is said.
        """
        stop = self._service.to_release
        if not self._may_ask():
            return None
        if stop is None:
            self._terminal.say("the robot has not told yet whether it stands for a stop; press the key again")
            return None
        self._service.arming()

        def arm() -> None:
            if stop:
                self._call("arm", ArmRequest(stop=stop, session=self._node.session))
                self._answers.put(self._service.armed)

        return arm

    def _call(self, verb: str, request: Strict) -> Callable[[], None]:
        self._node.bus.call("robot", verb, request, Nothing, ANSWER_S)
        return lambda: None

    def _inquire(self) -> None:
        """Ask the robot how it is where it has fallen silent, or has no episode yet."""
        asked_s = self._clock()
        if self._inquiring or asked_s - self._heard_s < ASK_S:
            return
        self._inquiring = True

        def take(status: Status | None) -> None:
            self._inquiring = False
            if self._heard_s > asked_s:
                return
            if status is None:
                self._status.on_silence()
                return
            if status.detail["episode"] is None:
                self._service.no_episode()
                self._status.on_answer(cast("StopCause | None", status.detail["stop_cause"]))
            self._node.publish(self._service.told(cast("int", status.detail["emergency_stop"])))

        def inquire() -> None:
            try:
                status = self._node.bus.call("robot", "status", Nothing(), Status, ANSWER_S)
            except Exception:  # noqa: BLE001 - whatever it is, the robot does not tell
                status = None
            self._answers.put(lambda: take(status))

        threading.Thread(target=inquire, name="inquiry", daemon=True).start()

    def _may_ask(self) -> bool:
        if self._asking is not None:
            self._terminal.say("still waiting for the robot")
        return self._asking is None

    def _ask(self, question: Callable[[], Callable[[], None]], failed: Callable[[], None] = lambda: None) -> None:
        """Ask the robot something; what it returns, or says why not, is done on the node's thread."""

        def refused(reason: str) -> None:
            self._terminal.say(reason)
            failed()

        def answered() -> None:
            self._service.answered()
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

    def _take_answers(self) -> None:
        with suppress(Empty):
            while True:
                self._answers.get_nowait()()
