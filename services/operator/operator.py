"""A person who drives, on the bus: their commands and signs of life, and what they ask of the robot."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from itertools import count
from queue import Empty, SimpleQueue
from typing import Final, Protocol, cast

from schemas import topics
from schemas.base import Atom, Strict
from schemas.command import CommandApplied, StopCause
from schemas.episode import Episode
from schemas.heartbeat import Heartbeat
from schemas.rpc import ArmRequest, EndRequest, Nothing, ResetReply, ResetRequest, ResumeRequest, Status
from services.kit.node import Node, ServiceError
from services.operator.commands import Commands
from services.operator.hold import KeyHold

#: How often releases of keys and the robot's answers have to be noticed, see ``Operator.poll``.
POLL_S: Final = 0.02
#: How often the robot has to hear that the operator is there; it misses them after five times that.
BEAT_S: Final = 0.05
#: A simulator's first frame takes seconds; another world of thousands of houses opens in minutes.
RESET_S: Final = 60.0
_OPEN_S: Final = 600.0
ANSWER_S: Final = 5.0
#: How often the robot is asked how it is, where it does not tell by its heartbeat, which beats ten times a second.
ASK_S: Final = 0.5


class Reports(Protocol):
    """Tells the operator what is heard of the robot."""

    def say(self, text: str) -> None:
        """Tell one thing, once."""

    def on_applied(self, applied: CommandApplied) -> None:
        """Take the robot's heartbeat."""

    def on_event(self, event: Episode) -> None:
        """Take an episode's event."""

    def on_request(self) -> None:
        """Take note that a new episode was asked for."""

    def on_failure(self) -> None:
        """Take note that it was refused."""

    def on_answer(self, cause: StopCause | None) -> None:
        """Take why the robot stands that has no episode; None where it is armed."""

    def on_silence(self) -> None:
        """Take note that it does not answer."""


class Operator:
    """Wires what a person does to a node; everything happens on the node's thread.

    Whoever owns it calls ``poll`` every ``POLL_S`` or sooner, and ``beat`` every ``BEAT_S`` while the person is there.

    Parameters
    ----------
    node
        Where to publish.
    keys
        Tells which movement is asked for.
    reports
        Tells the person.
    clock
        Monotonic seconds.
    """

    def __init__(
        self, node: Node, keys: KeyHold, reports: Reports, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._node = node
        self._reports = reports
        self._clock = clock
        self.commands = Commands(keys, node.robot)
        #: The running episode, if it was begun here, and how it was asked for.
        self.mine: str | None = None
        self.request: ResetRequest | None = None
        self._beats = count()
        self._heard_s = -math.inf
        self._inquiring = False
        # One question to the robot at a time, in a thread of its own: an emergency stop must not wait for its answer.
        self._asking: threading.Thread | None = None
        self._answers: SimpleQueue[Callable[[], None]] = SimpleQueue()
        node.subscribe(topics.APPLIED, self.on_applied)
        node.subscribe(topics.EPISODE, self.on_event)
        node.every(ASK_S, self._inquire)
        self._inquire()

    # -- what is heard --------------------------------------------------------------------------------------------

    def on_applied(self, applied: CommandApplied) -> None:
        """Answer the robot's heartbeat."""
        self._heard_s = self._clock()
        self._node.publish(self.commands.handle(applied))
        self._reports.on_applied(applied)

    def on_event(self, event: Episode) -> None:
        """Follow the episode."""
        self.commands.on_event(event)
        self._reports.on_event(event)
        if event.event == "ended" and event.episode == self.mine:
            self.mine = None

    def poll(self) -> None:
        """Notice releases of keys, and answers."""
        self._node.publish(self.commands.poll())
        with suppress(Empty):
            while True:
                self._answers.get_nowait()()

    # -- what is done ---------------------------------------------------------------------------------------------

    def beat(self, *, present: bool = True) -> None:
        """Tell the robot that the operator is there, or leaves."""
        beat = Heartbeat.after(
            self.commands.heard, session=self._node.session, sequence=next(self._beats), operator=True, present=present
        )
        self._node.publish(beat)

    def press(self, atom: Atom, until_s: float | None = None) -> None:
        """Take a press or a repeat of a key that moves the robot or stops it; see ``KeyHold.press``."""
        self._node.publish(self.commands.press(atom, until_s))

    def release(self, atom: Atom | None = None) -> None:
        """Let go of a key, or of every key at once."""
        self._node.publish(self.commands.release(atom))

    def stop_for_emergency(self) -> None:
        """Stop, and stay so until the robot is armed."""
        self._node.publish(self.commands.stop_for_emergency())

    def begin(
        self,
        request: ResetRequest,
        prepare: Callable[[], None] = lambda: None,
        there: Callable[[], bool] = lambda: True,
        begun: Callable[[ResetReply], None] = lambda _: None,
    ) -> bool:
        """Arm the robot if it has to be, and ask for an episode.

        Parameters
        ----------
        request
            The episode; it will be this operator's.
        prepare
            Called first, on another thread; what it raises is told, and no episode begins.
        there
            Whether the person is still there, who may have left meanwhile: both to prepare and to begin may take long.
        begun
            Called when the episode has begun, on the node's thread.

        Returns
        -------
        bool
            Whether it is asked for; why not is told.
        """
        request = request.model_copy(update={"session": self._node.session})
        arm = self._arming()
        if arm is None:
            return False

        def ask() -> Callable[[], None]:
            prepare()
            if not there():
                raise ServiceError("not begun: who asked for it has left")
            arm()
            if request.driver != "teleop":
                self._hand_over()
            stays = request.world is None and request.variation is None
            reply = self._node.bus.call("robot", "reset", request, ResetReply, RESET_S if stays else _OPEN_S)
            if not there():
                self.call("end", EndRequest(episode=reply.episode))
                raise ServiceError("ended at once: who asked for it has left")

            def done() -> None:
                begun(reply)
                if reply.episode != self.commands.last_ended:
                    self.mine, self.request = reply.episode, request

            return done

        self._reports.on_request()
        self.ask(ask, self._reports.on_failure)
        return True

    def _hand_over(self) -> None:
        """End what this person has taken over, so that another driver may begin anew; on a thread that asks."""
        bus = self._node.bus
        detail = bus.call("robot", "status", Nothing(), Status, ANSWER_S).detail
        if not detail["taken_over"]:
            return
        if detail["episode"] is not None:
            self.call("end", EndRequest(episode=str(detail["episode"])))
        heard = self.commands.heard
        self.call("resume", ResumeRequest(episode=heard.episode, tick=heard.tick, session=self._node.session))

    def resume(self) -> None:
        """Arm the robot if it has to be, and have whoever the operator has taken over from go on, or begin the next."""
        if self.commands.held is not None:
            self._reports.say("let go of the key first")
            return
        heard = self.commands.heard
        request = ResumeRequest(episode=heard.episode, tick=heard.tick, session=self._node.session)
        arm = self._arming()
        if arm is None:
            return

        def ask() -> Callable[[], None]:
            arm()
            if self._node.bus.call("robot", "status", Nothing(), Status, ANSWER_S).detail["taken_over"]:
                return self.call("resume", request)
            return lambda: self._reports.say("the robot is armed")

        self.ask(ask)

    def end(self, *, found: bool) -> None:
        """End the episode, at its goal if the operator says so."""
        applied = self.commands.applied
        if applied is None:
            self._reports.say("no episode to end")
        elif self._may_ask():
            self.release()
            request = EndRequest(episode=applied.episode, found=found, session=self._node.session)
            self.ask(lambda: self.call("end", request))

    def end_mine(self) -> None:
        """End the episode that was begun here, as its task says."""
        if self.mine is not None:
            request = EndRequest(episode=self.mine)
            self.ask(lambda: self.call("end", request))

    # -- asking ---------------------------------------------------------------------------------------------------

    @property
    def asking(self) -> bool:
        """Whether the answer to a question is still waited for."""
        return self._asking is not None

    def ask(self, question: Callable[[], Callable[[], None]], failed: Callable[[], None] = lambda: None) -> None:
        """Ask something in a thread; what it returns, or says why not, is done on the node's thread."""

        def refused(reason: str) -> None:
            self._reports.say(reason)
            failed()

        def answered() -> None:
            self.commands.answered()
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

    def call(self, verb: str, request: Strict) -> Callable[[], None]:
        """Call the robot, from a thread that asks; returns what has to be done then, which is nothing."""
        self._node.bus.call("robot", verb, request, Nothing, ANSWER_S)
        return lambda: None

    def _may_ask(self) -> bool:
        if self.asking:
            self._reports.say("still waiting for the robot")
        return not self.asking

    def _arming(self) -> Callable[[], None] | None:
        """Return what releases the stop that the operator knows of when they press the key, and no other one.

        None where the robot may not be asked, which is said.
        """
        stop = self.commands.to_release
        if not self._may_ask():
            return None
        if stop is None:
            self._reports.say("the robot has not told yet whether it stands for a stop; press again")
            return None
        self.commands.arming()

        def arm() -> None:
            if stop:
                self.call("arm", ArmRequest(stop=stop, session=self._node.session))
                self._answers.put(self.commands.armed)

        return arm

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
                self._reports.on_silence()
                return
            if status.detail["episode"] is None:
                self.commands.no_episode()
                self._reports.on_answer(cast("StopCause | None", status.detail["stop_cause"]))
            self._node.publish(self.commands.told(cast("int", status.detail["emergency_stop"])))

        def inquire() -> None:
            try:
                status = self._node.bus.call("robot", "status", Nothing(), Status, ANSWER_S)
            except Exception:  # noqa: BLE001 - whatever it is, the robot does not tell
                status = None
            self._answers.put(lambda: take(status))

        threading.Thread(target=inquire, name="inquiry", daemon=True).start()
