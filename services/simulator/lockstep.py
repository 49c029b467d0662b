"""Lockstep: the world moves on when a frame is answered, so that episodes do not depend on how fast the machine is."""

from collections.abc import Callable, Iterator
from typing import Final

from schemas.base import KEYS, STANDING, Atom, Message, Velocity
from schemas.rpc import ResetRequest
from services.kit.node import Detail
from services.robot.body import Kinematics
from services.robot.clock import TICK_S, now_s
from services.robot.episode import RunningEpisode
from services.robot.gate import bounded
from services.robot.guard import guard_of
from services.robot.pace import Running, Teller
from services.robot.wheels import WheelCheck
from services.simulator.body import SimulatedBody
from services.simulator.sensors.camera import FindVictim, SimulatedView
from services.simulator.simulation import Simulation

#: Seconds without an answer after which a frame is sent again (a message may be lost), and given up.
RESEND_S: Final = 2.0
GIVE_UP_S: Final = 30.0


class LockstepEpisode(RunningEpisode[SimulatedView]):
    """An episode in this process, for whoever acts on its views; the same seed gives the same poses as by messages."""

    def __init__(self, simulation: Simulation, request: ResetRequest) -> None:
        body = SimulatedBody(simulation)
        super().__init__(body, FindVictim(), request)
        self._simulated = body
        self._guard = guard_of(body)
        self._wheels = WheelCheck(body.kinematics)
        #: Why the robot stands until the end, if its senses contradict each other.
        self.contradiction: str | None = None

    @property
    def kinematics(self) -> Kinematics:
        """How the robot can move."""
        return self._simulated.kinematics

    def step(self, asked: Atom | Velocity) -> SimulatedView:
        """Carry out a key or a velocity, or what the gate would let through, until the next frame, and return that."""
        now_s = self.tick * TICK_S
        wheels = self.view.odometry[:3]
        self.contradiction = self.contradiction or self._wheels.read(wheels, now_s)
        if self._guard is not None and self.contradiction is None:
            self._guard.look(self.view.depth, wheels, now_s)
        wanted = KEYS[asked] if isinstance(asked, str) else asked
        may, _ = bounded(
            STANDING if self.contradiction else wanted, self.kinematics, self._guard, now_s
        )
        self._wheels.told(may, now_s)
        self._simulated.advance(may, TICK_S)
        return self.next_frame()


class Lockstep:
    """The pace of a simulated robot whose world waits for commands; `clock` times what was not answered."""

    delay_s = 0.0  # The world waits.

    def __init__(self, body: SimulatedBody, clock: Callable[[], float] = now_s) -> None:
        self._body = body
        self._clock = clock
        self._sent_s = clock()
        self.resent = 0

    def gate_s(self, tick: int) -> float:
        """Return simulated time, so that a slow machine makes no command stale."""
        return tick * TICK_S

    def captured_s(self, _view: SimulatedView, tick: int) -> float:
        """Return the time of the frame."""
        return self.gate_s(tick)

    def detail(self) -> Detail:
        """Tell how often a frame was sent again."""
        return {"resent": self.resent}

    def begin(self) -> None:
        """Wait for the first answer."""
        self._sent_s = self._clock()

    def end(self) -> None:
        """Do nothing: time stands."""

    def poll(self, runner: Teller[SimulatedView], run: Running[SimulatedView]) -> Iterator[Message]:
        """Move on if the last frame is answered; send it again, or give up, when an answer is overdue."""
        # Asked in this order: of an answer that comes between the two, the next poll makes a step.
        answered = runner.gate.answered(run.tick)
        applied = runner.gate.applied(self.gate_s(run.tick))
        if runner.gate.emergency_stop:
            if run.applied is None or run.applied.reason != "emergency_stop":
                yield runner.tell(run, applied)
        elif answered:
            yield runner.tell(run, applied)
            if runner.gate.stop_cause is not None:
                return  # it came while that was being said
            runner.gate.carries_out(applied.velocity, self.gate_s(run.tick))
            self._body.advance(applied.velocity, TICK_S)
            yield from runner.next_frame(run)
            self._sent_s = self._clock()
            return
        now = self._clock()
        if now - run.ready_s[run.tick] > GIVE_UP_S:
            yield from runner.end()
        elif now - self._sent_s > RESEND_S and not runner.gate.emergency_stop:
            # Who wants the other images may have come, or have become known, only after the frame was made.
            *others, image = run.frame
            made = {message.topic_name for message in others}
            run.frame = (*others, *run.episode.view.more(runner.header(run), made), image)
            runner.gate.expect_anybody()
            self._sent_s = self._clock()
            self.resent += 1
            yield from run.frame
