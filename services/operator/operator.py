"""The operator on the bus: commands, heartbeats and requests to the robot."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import count
from queue import Empty, SimpleQueue
from typing import Any, Final

from schemas import topics
from schemas.base import NO_EPISODE, TICK_S, Atom, Message, Source, Strict, Velocity
from schemas.command import CommandApplied, StopCause
from schemas.episode import Box, Episode, Outcome, Purpose, Said, in_words
from schemas.heartbeat import Heartbeat, Pulse
from schemas.rpc import (
    ArmRequest,
    CancelRequest,
    CarryRequest,
    EndRequest,
    Nothing,
    ResetReply,
    ResetRequest,
    ResumeRequest,
    Status,
    TaskRequest,
)
from services.kit.bus import RpcError
from services.kit.errors import JobError
from services.kit.node import Node, ServiceError
from services.operator.commands import Commands

# Period of ``Operator.poll``, which detects released keys and answers.
POLL_S: Final = 0.02
# A simulator's first frame takes seconds; a world of thousands of houses opens in minutes.
RESET_S: Final = 60.0
_OPEN_S: Final = 600.0
ANSWER_S: Final = 5.0
#: Period of the reports about a robot without an episode, whose pulses arrive more often.
LOOK_S: Final = 0.5
SILENCE_S: Final = 1.0  # Silence after which the robot is reported as silent; twenty pulses.
# Fields of the report.
_APPLIED: Final = (
    "episode",
    "tick",
    "atom",
    "linear",
    "angular",
    "source",
    "reason",
    "refused",
)
# Fields of the report that only the start of an episode contains.
_UNKNOWN: Final = (
    "purpose",
    "driver",
    "goal",
    "world",
    "outcome",
    "right",
    "seconds",
    "rate_hz",
    "moved",
)
# Number of pulses that can still be answered, with some reserve; they arrive every 0.05 s.
_PULSES: Final = 16
#: Period of a repeated emergency stop until the robot reports it; equal to the robot's report
#: period.
REPEAT_S: Final = TICK_S


@dataclass(frozen=True)
class Report:
    """Last known state of the robot and its episode."""

    # Time of the robot's last report, by the operator's clock; None before the first.
    at: float | None = None
    answers: bool = False
    waiting: bool = False  # An episode was requested and has not begun yet.
    # An emergency stop was requested here, and the robot was not armed since.
    emergency: bool = False
    cause: StopCause | None = None  # Why the robot stands until it is armed.
    episode: str | None = None
    # Newest frame and motion of the running episode, or of the last one.
    tick: int = 0
    atom: Atom | None = None
    linear: float = 0.0
    angular: float = 0.0
    source: Source | None = None
    reason: str | None = None
    refused: int = 0
    purpose: Purpose | None = None  # Start of the episode; None if unknown.
    driver: Source | None = None
    goal: str | None = None
    world: str | None = None
    outcome: Outcome | None = None
    right: bool | None = None  # Whether the report "not here" is right; None if unknown.
    # Duration of the running episode, or of the last one, by the robot's clock, which is simulated in
    # a simulation; None if its start was not received.
    seconds: float | None = None
    rate_hz: float | None = None  # Mean rate of its frames in real time; None if unknown.
    moved: bool | None = None  # Whether it has driven ahead or back; None if unknown.
    kidnapped: int = 0  # How often it was kidnapped in the running episode, or in the last one.


class Operator:
    """Connects a person's actions to a node; the methods run on the node's thread.

    The owner calls ``poll`` every ``POLL_S`` or sooner. ``say`` prints one line to the person;
    ``show`` displays the changed report. Each pulse of the robot is answered while the person is
    ``there``, by default for the lifetime of the process. If presence is known only for moments,
    call ``beat``.
    """

    def __init__(
        self,
        node: Node,
        say: Callable[[str], None],
        show: Callable[[Report], None] = lambda _: None,
        clock: Callable[[], float] = time.monotonic,
        there: Callable[[], bool] = lambda: True,
    ) -> None:
        self._node = node
        self._say = say
        self._show = show
        self._clock = clock
        self._there = there
        self.report = Report()
        self.commands = Commands(node.robot, clock)
        # The running episode, if it was begun here, and its request.
        self.mine: str | None = None
        self.request: ResetRequest | None = None
        # Start of the episode, by this process's clock and by the robot's.
        self._began_s = 0.0
        self._began_ns = 0
        self._beats = count()
        # Time of the last message of the robot, and of its episode.
        self._heard_s = self._applied_s = -math.inf
        self._pulses: deque[tuple[float, Pulse]] = deque(maxlen=_PULSES)
        # One request at a time, on a separate thread: an emergency stop must not wait for its
        # answer.
        self.asking = False
        self._answers: SimpleQueue[Callable[[], None]] = SimpleQueue()
        #: Set to withdraw the requested episode; None without a request.
        self._withdrawn: threading.Event | None = None
        node.subscribe(topics.APPLIED, self._on_applied)
        node.subscribe(topics.EPISODE, self._on_event)
        node.subscribe(topics.PULSE, self._on_pulse)
        node.every(LOOK_S, self._look)
        node.every(REPEAT_S, lambda: node.publish(self.commands.repeat_stop()))

    # -- received ----------------------------------------------------------------------------------

    def _on_applied(self, applied: CommandApplied) -> None:
        """Answer a report of the robot."""
        self._heard_s = self._applied_s = self._clock()
        self._node.publish(self.commands.handle(applied))
        if applied.episode == self.commands.last_ended:
            return
        news = {name: getattr(applied, name) for name in _APPLIED}
        if applied.episode != self.report.episode:
            # It began before this process, so its details are unknown.
            news |= dict.fromkeys(_UNKNOWN) | {"kidnapped": 0}
        else:
            news |= self._times(applied)
            if applied.linear and self.report.moved is not None:
                news["moved"] = True
        self._note(
            **news,
            cause=applied.stop_cause,
            at=self._heard_s,
            answers=True,
            waiting=False,
        )

    def _on_event(self, event: Episode) -> None:
        self.commands.on_event(event)
        names = ("purpose", "driver", "goal", "world", "outcome", "right", "tick")
        told = {name: getattr(event, name) for name in names}
        named = f"{'Run' if event.purpose == 'run' else 'Drive'} to {event.goal}"
        if event.event == "started":
            self._began_s = self._clock()
            self._began_ns = event.stamp_ns
            self._note(
                **told,
                at=self._began_s,
                waiting=False,
                episode=event.episode,
                seconds=0.0,
                rate_hz=None,
                moved=False,
                kidnapped=0,
            )
        elif event.event == "ended":
            self._note(**told, at=self._clock(), episode=None, **self._times(event))
            # The first frame has tick 0.
            frames = event.tick + 1
            self._say(f"{named}: {in_words(event.outcome, event.right)} after {frames} frames")
            if event.episode == self.mine:
                self.mine = None
        else:
            if event.event == "kidnapped":
                self._note(kidnapped=self.report.kidnapped + 1)
            happened = event.event.replace("_", " ")
            # Ground truth: the robot has reported nothing yet.
            if event.event == "victim_found":
                happened = "the victim is near and in view"
            self._say(f"{named}, frame {event.tick}: {happened}")

    def _on_pulse(self, pulse: Pulse) -> None:
        """Answer the robot's pulse if the person is present."""
        first = not self._pulses
        self._heard_s = self._clock()
        self._pulses.append((self._heard_s, pulse))
        if self._there():
            self.beat()
        if first:
            self._look()

    def _look(self) -> None:
        """Report the state of a robot that is silent or has no episode."""
        now = self._clock()
        if now - self._heard_s > SILENCE_S:
            self._note(answers=False)
        elif self._pulses and now - self._applied_s >= LOOK_S:
            heard_s, pulse = self._pulses[-1]
            # On a busy machine the last pulse can be from before the start of the episode.
            if pulse.episode == NO_EPISODE and heard_s > self._began_s:
                self.commands.no_episode()
                self._note(at=now, answers=True, episode=None, cause=pulse.stop_cause)
            self._node.publish(self.commands.told(pulse.latched_stop))

    def _times(self, frame: Message) -> dict[str, float | None]:
        """Return the duration at a frame, and the mean rate; None if the start was not received."""
        if self.report.seconds is None:
            return {"seconds": None, "rate_hz": None}
        passed_s = self._clock() - self._began_s
        return {
            "seconds": (frame.stamp_ns - self._began_ns) / 1e9,
            "rate_hz": frame.tick / passed_s if passed_s > 0.0 else None,
        }

    def _note(self, **news: Any) -> None:  # noqa: ANN401 - of the report's fields
        before = self.report
        self.report = replace(self.report, **news)
        if self.report != before:
            self._show(self.report)

    def poll(self) -> None:
        """Detect released keys, and handle answers."""
        self._node.publish(self.commands.poll())
        with suppress(Empty):
            while True:
                self._answers.get_nowait()()
        self._note(emergency=self.commands.emergency)

    # -- actions -----------------------------------------------------------------------------------

    def beat(self, as_of_s: float = math.inf, *, present: bool = True) -> None:
        """Send a heartbeat that the operator is present, or leaves, as of a time.

        It answers the last pulse received by ``as_of_s`` of the clock, by default now; without a
        pulse it is not sent.
        """
        for heard_s, pulse in reversed(self._pulses):
            if heard_s <= as_of_s:
                node = self._node
                sequence = next(self._beats)
                fields = {
                    "session": node.session,
                    "name": node.name,
                    "sequence": sequence,
                    "answers": pulse.number,
                }
                node.publish(Heartbeat.after(pulse, **fields, present=present))
                return

    def hold(self, held: Velocity | None, until_s: float = 0.0) -> None:
        """Hold a velocity; see ``Commands.hold``."""
        self._node.publish(self.commands.hold(held, until_s))

    def stop_for_emergency(self) -> None:
        """Stop until the robot is armed."""
        if not self.commands.emergency:
            self._say("EMERGENCY STOP, until the robot is armed")
        self._node.publish(self.commands.stop_for_emergency())

    def begin(
        self,
        request: ResetRequest,
        prepare: Callable[[], None] = lambda: None,
        there: Callable[[], bool] = lambda: True,
        begun: Callable[[ResetReply], None] = lambda _: None,
    ) -> bool:
        """Arm the robot if necessary, and request an episode of this operator.

        Parameters
        ----------
        request
            The episode.
        prepare
            Called first, on another thread; if it raises an error, no episode begins.
        there
            Whether the person is still present; both steps can take long, and no episode begins
            without them.
        begun
            Called with the reply on the node's thread.

        Returns
        -------
        bool
            Whether the request was sent.
        """
        request = request.model_copy(update={"session": self._node.session})
        arm = self._arming()
        if arm is None:
            return False
        self._withdrawn = withdrawn = threading.Event()

        def gone() -> str:
            if withdrawn.is_set():
                return "it was cancelled"
            return "" if there() else "the person who asked has left"

        def ask() -> Callable[[], None]:
            prepare()
            if why := gone():
                raise ServiceError(f"not begun: {why}")
            arm()
            reply = self._reset(request)
            if why := gone():
                self._call("end", EndRequest(episode=reply.episode, session=self._node.session))
                raise ServiceError(f"ended at once: {why}")
            return lambda: self._begun(request, reply, begun)

        self._note(waiting=True)
        self.ask(ask)
        return True

    def _reset(self, request: ResetRequest) -> ResetReply:
        """Request an episode from the robot."""
        if request.driver != "teleop":
            self._hand_over()
        stays = request.world is None and request.variation is None
        timeout_s = RESET_S if stays else _OPEN_S
        return self._node.bus.call("robot", "reset", request, ResetReply, timeout_s)

    def _begun(
        self, request: ResetRequest, reply: ResetReply, begun: Callable[[ResetReply], None]
    ) -> None:
        begun(reply)
        if reply.episode != self.commands.last_ended:
            self.mine = reply.episode
            self.request = request

    def withdraw(self) -> None:
        """Withdraw the requested episode, even while the robot opens its world."""
        mine = self._withdrawn
        if mine is not None:
            mine.set()

        def cancel() -> None:
            try:
                self._call("cancel", CancelRequest(session=self._node.session))
            except RpcError as error:
                reason = str(error)
                # The thread that requested an episode here ends it itself.
                self._answers.put(lambda: None if mine is not None else self._say(reason))

        # Concurrent with the request, which it ends.
        threading.Thread(target=cancel, name="cancel", daemon=True).start()

    def resume(self) -> None:
        """Arm the robot if necessary, and return control to its previous driver."""
        if self.commands.held is not None:
            self._say("let go first, then resume")
            return
        request = self._resuming()
        arm = self._arming()
        if arm is None:
            return

        def ask() -> Callable[[], None] | None:
            arm()
            if not self._robot_detail()["taken_over"]:
                return lambda: self._say("the robot is armed")
            self._call("resume", request)
            return None

        self.ask(ask)

    def end(self, *, found: bool, box: Box | None = None) -> None:
        """End the episode; with ``found`` at its goal, optionally with a box in the last frame."""
        applied = self.commands.applied
        if applied is None:
            self._say("no episode to end")
        elif self._may_ask():
            self.hold(None)
            request = EndRequest(
                episode=applied.episode, found=found, box=box, session=self._node.session
            )
            self.ask(lambda: self._call("end", request))

    def end_mine(self, said: Said | None = None) -> None:
        """End the episode that was begun here, with the robot's report if any."""
        if self.mine is not None:
            request = EndRequest(episode=self.mine, said=said, session=self._node.session)
            self.ask(lambda: self._call("end", request))

    def place(
        self, request: CarryRequest | TaskRequest, placed: Callable[[], None] = lambda: None
    ) -> None:
        """Carry a simulated robot, or choose its task; then call ``placed``, on another thread."""
        verb = "carry" if isinstance(request, CarryRequest) else "task"

        def ask() -> None:
            self._call(verb, request.model_copy(update={"session": self._node.session}))
            placed()

        if self._may_ask():
            self.ask(ask)

    # -- requests ----------------------------------------------------------------------------------

    def ask(self, question: Callable[[], Callable[[], None] | None]) -> None:
        """Run a request on a thread; its result, or its error, is handled on the node's thread."""

        def refused(reason: str) -> None:
            self._say(reason)
            self._note(waiting=False)

        def answered() -> None:
            self.commands.answered()
            self.asking = False
            self._withdrawn = None

        def ask() -> None:
            try:
                done = question() or (lambda: None)
            except JobError as error:
                reason = str(error)
                done = lambda: refused(reason)  # noqa: E731
            except Exception:  # Any error: otherwise no further request is possible.
                self._node.log.exception("asking failed")
                done = lambda: refused(self._node.own_fault)  # noqa: E731
            self._answers.put(done)
            self._answers.put(answered)

        self.asking = True
        threading.Thread(target=ask, name="question", daemon=True).start()

    def _call(self, verb: str, request: Strict) -> None:
        self._node.bus.call("robot", verb, request, Nothing, ANSWER_S)

    def _robot_detail(self) -> dict[str, Any]:
        return self._node.bus.call("robot", "status", Nothing(), Status, ANSWER_S).detail

    def _resuming(self) -> ResumeRequest:
        heard = self.commands.heard
        return ResumeRequest(episode=heard.episode, tick=heard.tick, session=self._node.session)

    def _hand_over(self) -> None:
        """End the person's own control, so that another driver can begin; on a requesting thread."""
        detail = self._robot_detail()
        if not detail["taken_over"]:
            return
        if detail["episode"] is not None:
            self._call(
                "end", EndRequest(episode=str(detail["episode"]), session=self._node.session)
            )
        self._call("resume", self._resuming())

    def _may_ask(self) -> bool:
        if self.asking:
            self._say("the robot has not answered yet; wait")
        return not self.asking

    def _arming(self) -> Callable[[], None] | None:
        """Return the function that releases the known stop; None if the robot must not be asked."""
        stop = self.commands.to_release
        if not self._may_ask():
            return None
        if stop is None:
            self._say("the robot has not answered yet; press again")
            return None
        self.commands.arming()

        def arm() -> None:
            if stop:
                self._call("arm", ArmRequest(stop=stop, session=self._node.session))
                self._answers.put(self.commands.armed)

        return arm
