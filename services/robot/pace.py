"""How time passes in an episode: in real time by the clock; another pace (the simulator's lockstep) may be given."""

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final, Generic, Protocol, TypeVar

from schemas.base import Message, Source
from schemas.command import CommandApplied
from schemas.rpc import Mode, ResetRequest
from services.kit.node import Detail
from services.robot.body import Body, View
from services.robot.clock import TICK_S
from services.robot.episode import RunningEpisode
from services.robot.gate import Applied, CommandGate
from services.robot.loop import ActuatorLoop
from services.robot.radio import RadioWindow

#: What moves the robot changes at most 50 times a second; so much is told after an outage of 10 s, the newest.
CHANGES_KEPT: Final = 500
V = TypeVar("V", bound=View)


@dataclass
class Running(Generic[V]):
    """The state of the running episode."""

    id: str
    episode: RunningEpisode[V]
    pace: "Pace[V]"
    begun_s: float  # When it began, by the gate's time and by the wall clock.
    begun_ns: int
    #: When the last frame was captured; the wall clock is read once an episode, since it may be set meanwhile.
    stamp_ns: int
    client_s: float  # When the client that began it was last heard of.
    client_beat: int = -1  # The number of its last sign of life.
    found: bool = False  # Whether the goal has been reached at all.
    applied: Applied | None = None
    said: int = 0  # How many times it was said in this tick what moves the robot.
    #: When recent frames were ready to be sent, and how long each source's last accepted command took from then.
    ready_s: dict[int, float] = field(default_factory=dict)
    latency_s: dict[Source, float] = field(default_factory=dict)
    window: RadioWindow = field(
        default_factory=RadioWindow
    )  # Which frames have a picture, by radio.
    frame: tuple[
        Message, ...
    ] = ()  # The messages of the last frame that a driver needs to answer it.

    @property
    def request(self) -> ResetRequest:
        """How it was asked for."""
        return self.episode.request

    @property
    def tick(self) -> int:
        """Number of the last frame."""
        return self.episode.tick


class Teller(Protocol[V]):
    """Who takes the frames and tells of them: the runner, as far as a pace needs it."""

    gate: CommandGate
    running: Running[V] | None  # The running episode, if any.

    def next_frame(self, run: Running[V]) -> Iterator[Message]:
        """Take the next frame, and end the episode if it ends with it."""

    def tell(self, run: Running[V], applied: Applied) -> CommandApplied:
        """Make the record of what moves the robot."""

    def header(self, run: Running[V]) -> Message:
        """Return what every message of the last frame begins with."""

    def end(self) -> list[Message]:
        """End the running episode."""


class Pace(Protocol[V]):
    """When the next frame is, and what moves the robot until then."""

    def gate_s(self, tick: int) -> float:
        """Return the gate's time, by which commands grow old, while ``tick`` is the last frame."""

    def captured_s(self, view: V, tick: int) -> float:
        """Return the gate's time at which the frame of a tick was captured."""

    @property
    def delay_s(self) -> float:
        """Time from the capture of a frame to the moment when the command that answers it began to move the robot."""

    def detail(self) -> Detail:
        """Tell how time passes, for the robot's status."""

    def begin(self) -> None:
        """Begin, with frame 0 taken."""

    def poll(self, runner: Teller[V], run: Running[V]) -> Iterator[Message]:
        """Let time pass."""

    def end(self) -> None:
        """Leave the robot standing."""


Paces = Mapping[
    Mode, Callable[[], Pace[V]]
]  # How time passes, by mode; each episode has a pace of its own.


class RealTime(Generic[V]):
    """The clock runs: a frame every ``frame_s``, while a loop drives; ``wake`` has somebody call ``poll`` soon.

    While the robot is ``deaf`` to stops or commands the loop lets it stand.
    """

    def __init__(
        self,
        gate: CommandGate,
        body: Body[V],
        clock: Callable[[], float],
        wake: Callable[[], None],
        frame_s: float = TICK_S,
        deaf: Callable[[], bool] = lambda: False,
    ) -> None:
        self._deaf = deaf
        self._frame_s = frame_s
        self._clock = clock
        self._wake = wake
        self._changes: deque[Applied] = deque(maxlen=CHANGES_KEPT)
        self.loop = ActuatorLoop(gate, body, self._note, clock, deaf)
        self._due_s = 0.0
        self.late = 0

    @property
    def delay_s(self) -> float:
        """As the loop has measured it."""
        return self.loop.delay_s

    def _note(self, applied: Applied) -> None:
        self._changes.append(applied)
        self._wake()

    def gate_s(self, _tick: int) -> float:
        """Return the clock's time."""
        return self._clock()

    def captured_s(self, view: V, _tick: int) -> float:
        """Return what the body says; one whose clock is ahead must not keep commands fresh for longer."""
        return min(view.captured_s, self._clock())

    def detail(self) -> Detail:
        """Tell how often a frame, or a step of the loop, came late."""
        return {"late_frames": self.late, "late_steps": self.loop.late}

    def begin(self) -> None:
        """Start the loop."""
        self._due_s = self._clock() + self._frame_s
        self.loop.start()

    def poll(self, runner: Teller[V], run: Running[V]) -> Iterator[Message]:
        """Tell what has changed, and take the next frame if it is due."""
        while self._changes:
            yield runner.tell(run, self._changes.popleft())
        now = self._clock()
        if now < self._due_s:
            return
        # A frame that took longer than a tick to make puts off the next ones; the robot moves on meanwhile.
        self.late += now - self._due_s > self._frame_s
        self._due_s = max(self._due_s + self._frame_s, now)
        yield from runner.next_frame(run)
        if run is runner.running:
            yield runner.tell(run, runner.gate.applied(self._clock(), deaf=self._deaf()))

    def end(self) -> None:
        """Stop the loop, which leaves the robot standing."""
        self.loop.close()
