"""Passing of time in an episode: real time here, `lockstep` beside it."""

import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final, Generic, Protocol, TypeVar

from schemas.base import TICK_S, Message, Source
from schemas.command import CommandApplied
from schemas.rpc import Mode, ResetRequest
from services.kit.node import Detail
from services.robot.body import Body, View
from services.robot.clock import CLOCKS, SILENCE_S
from services.robot.episode import RunningEpisode
from services.robot.gate import Applied, CommandGate
from services.robot.loop import PERIOD_S, ActuatorLoop
from services.robot.radio import RadioWindow

#: Age of an unanswered frame at which a simulated clock waits for its answer, seconds: the command
#: for the frame before, a tick earlier, expires with the next step of the loop.
ANSWER_S: Final = SILENCE_S - TICK_S - PERIOD_S
#: Maximum changes of motion that are reported after an outage: 10 s at 50 changes a second.
CHANGES_KEPT: Final = 500
V = TypeVar("V", bound=View)


@dataclass
class Running(Generic[V]):
    """State of the running episode."""

    id: str
    episode: RunningEpisode[V]
    pace: "Pace[V]"
    begun_s: float  # Start, by the gate's time and by the wall clock.
    begun_ns: int
    #: Capture time of the last frame; the wall clock is read once per episode, since it can be set.
    stamp_ns: int
    client_s: float  # Time of the last heartbeat of the client that began it.
    client_beat: int = -1  # Sequence number of that heartbeat.
    found: bool = False  # Whether the goal has been reached in any frame.
    carried: bool = False  # Whether the robot was carried elsewhere since the last frame.
    applied: Applied | None = None
    said: int = 0  # Number of reports of the motion in this tick.
    #: Times at which recent frames were ready, and the latency of each source's last accepted
    #: command.
    ready_s: dict[int, float] = field(default_factory=dict)
    latency_s: dict[Source, float] = field(default_factory=dict)
    window: RadioWindow = field(default_factory=RadioWindow)  # Frames with an image, in radio mode.
    frame: tuple[Message, ...] = ()  # Messages of the last frame that a driver needs to answer it.

    @property
    def request(self) -> ResetRequest:
        """The request that began it."""
        return self.episode.request

    @property
    def tick(self) -> int:
        """Number of the last frame."""
        return self.episode.tick


class Teller(Protocol[V]):
    """Part of the runner that a pace uses."""

    gate: CommandGate
    running: Running[V] | None

    def next_frame(self, run: Running[V]) -> Iterator[Message]:
        """Take the next frame, and end the episode if it ends with it."""

    def tell(self, run: Running[V], applied: Applied) -> CommandApplied:
        """Return the record of the robot's motion."""

    def header(self, run: Running[V]) -> Message:
        """Return the common header of the last frame's messages."""

    def end(self) -> list[Message]:
        """End the running episode."""


class Pace(Protocol[V]):
    """Schedule of the frames, and the motion between them."""

    def gate_s(self, tick: int) -> float:
        """Return the gate's time, by which commands age, while ``tick`` is the last frame."""

    def captured_s(self, view: V, tick: int) -> float:
        """Return the gate's time at which the frame of a tick was captured."""

    @property
    def delay_s(self) -> float:
        """Delay from the capture of a frame to the motion by the command that answers it."""

    def detail(self) -> Detail:
        """Return the pace's part of the robot's status."""

    def begin(self) -> None:
        """Begin, with frame 0 taken."""

    def poll(self, runner: Teller[V], run: Running[V]) -> Iterator[Message]:
        """Advance the time."""

    def end(self) -> None:
        """Leave the robot standing."""


# Factories by mode; each episode has a pace of its own.
Paces = Mapping[Mode, Callable[[], Pace[V]]]


class RealTime(Generic[V]):
    """Real time: a frame every ``frame_s``, while a loop drives; ``wake`` requests a `poll`.

    While the robot is ``deaf`` to stops or commands it stands. ``hold`` lets the clock of a simulated
    robot wait for a frame that is late, and for the answer of a program that drives.
    """

    def __init__(
        self,
        gate: CommandGate,
        body: Body[V],
        clock: Callable[[], float],
        wake: Callable[[], None],
        frame_s: float = TICK_S,
        deaf: Callable[[], bool] = lambda: False,
        hold: Callable[[float], None] = CLOCKS.hold,
    ) -> None:
        self._deaf = deaf
        self._hold = hold
        self._frame_s = frame_s
        self._clock = clock
        self._wake = wake
        self._changes: deque[Applied] = deque(maxlen=CHANGES_KEPT)
        self.loop = ActuatorLoop(gate, body, self._note, clock, deaf)
        self._begun_s = self._due_s = 0.0
        self.late = 0

    @property
    def delay_s(self) -> float:
        """Delay measured by the loop."""
        return self.loop.delay_s

    def _note(self, applied: Applied) -> None:
        self._changes.append(applied)
        self._wake()

    def gate_s(self, _tick: int) -> float:
        """Return the clock's time."""
        return self._clock()

    def captured_s(self, view: V, _tick: int) -> float:
        """Return the body's capture time, at most now: a fast clock must not extend freshness."""
        return min(view.captured_s, self._clock())

    def detail(self) -> Detail:
        """Return the numbers of late frames and of late steps of the loop, and the body's error."""
        detail: Detail = {"late_frames": self.late, "late_steps": self.loop.late}
        if self.loop.fault is not None:
            detail["fault"] = self.loop.fault
        return detail

    def begin(self) -> None:
        """Start the loop."""
        self._begun_s = self._clock()
        self._due_s = self._begun_s + self._frame_s
        self.loop.start()

    def poll(self, runner: Teller[V], run: Running[V]) -> Iterator[Message]:
        """Report changes of motion, and take the next frame if it is due."""
        while self._changes:
            yield runner.tell(run, self._changes.popleft())
        self._wait_for(runner, run)
        now = self._clock()
        if now < self._due_s:
            return
        # A frame that takes longer than a tick postpones the following frames; the robot moves on
        # meanwhile.
        self.late += now - self._due_s > self._frame_s
        self._due_s = max(self._due_s + self._frame_s, now)
        yield from runner.next_frame(run)
        if run is runner.running:
            yield runner.tell(run, runner.gate.applied(self._clock(), deaf=self._deaf()))

    def _wait_for(self, runner: Teller[V], run: Running[V]) -> None:
        """Set the time at which the clock of a simulated robot waits."""
        until_s = self._due_s + self._frame_s
        gate = runner.gate
        # A person answers no frame.
        if run.request.driver != "teleop" and not (gate.taken_over or gate.latched_stop):
            answered_s = max(gate.answered_s or -math.inf, self._begun_s)
            until_s = min(until_s, answered_s + self._frame_s + ANSWER_S)
        self._hold(until_s)

    def end(self) -> None:
        """Stop the loop, which leaves the robot standing."""
        self._hold(math.inf)
        self.loop.close()
