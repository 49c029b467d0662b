"""Lockstep pace: the world advances with each answered frame, at the speed of any machine."""

from collections.abc import Callable, Iterator
from typing import Final

from schemas.base import KEYS, STANDING, TICK_S, Atom, Message, Velocity
from schemas.rpc import ResetRequest
from services.kit.node import Detail
from services.robot.body import Kinematics
from services.robot.clock import now_s
from services.robot.episode import RunningEpisode
from services.robot.gate import bounded
from services.robot.guard import guard_of
from services.robot.pace import Running, Teller
from services.robot.wheels import WheelCheck
from services.simulator.body import SimulatedBody
from services.simulator.sensors.camera import FindVictim, SimulatedView
from services.simulator.simulation import Simulation

#: Timeouts of an answer, seconds: resend the frame (a message can be lost), then end the episode.
RESEND_S: Final = 2.0
GIVE_UP_S: Final = 30.0


class LockstepEpisode(RunningEpisode[SimulatedView]):
    """An episode in this process, with the same poses as an episode over messages."""

    def __init__(self, simulation: Simulation, request: ResetRequest) -> None:
        body = SimulatedBody(simulation)
        super().__init__(body, FindVictim(), request)
        self._simulated = body
        self._guard = guard_of(body)
        self._wheels = WheelCheck(body.kinematics)
        #: Stop cause that holds until the end, after contradicting sensors.
        self.contradiction: str | None = None

    @property
    def kinematics(self) -> Kinematics:
        """Limits of the robot's motion."""
        return self._simulated.kinematics

    def step(self, asked: Atom | Velocity) -> SimulatedView:
        """Execute an action as far as the gate permits, and return the next view."""
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
    """Pace of a simulated robot whose world waits for commands; `clock` times the answers."""

    delay_s = 0.0  # The world waits.

    def __init__(self, body: SimulatedBody, clock: Callable[[], float] = now_s) -> None:
        self._body = body
        self._clock = clock
        self._sent_s = clock()
        self.resent = 0

    def gate_s(self, tick: int) -> float:
        """Return simulated time, so that a slow machine does not make commands stale."""
        return tick * TICK_S

    def captured_s(self, _view: SimulatedView, tick: int) -> float:
        """Return the capture time of a frame."""
        return self.gate_s(tick)

    def detail(self) -> Detail:
        """Report the number of frames that were sent again."""
        return {"resent": self.resent}

    def begin(self) -> None:
        """Wait for the first answer."""
        self._sent_s = self._clock()

    def end(self) -> None:
        """Do nothing; the world waits."""

    def poll(self, runner: Teller[SimulatedView], run: Running[SimulatedView]) -> Iterator[Message]:
        """Advance after an answer; resend the frame or end the episode after a timeout."""
        # This order matters: an answer between the two calls is handled at the next poll.
        answered = runner.gate.answered(run.tick)
        applied = runner.gate.applied(self.gate_s(run.tick))
        if runner.gate.latched_stop:
            if run.applied is None or run.applied.reason != "latched_stop":
                yield runner.tell(run, applied)
        elif answered:
            yield runner.tell(run, applied)
            if runner.gate.stop_cause is not None:
                return  # The stop arrived during the publication.
            runner.gate.carries_out(applied.velocity, self.gate_s(run.tick))
            self._body.advance(applied.velocity, TICK_S)
            yield from runner.next_frame(run)
            self._sent_s = self._clock()
            return
        now = self._clock()
        if now - run.ready_s[run.tick] > GIVE_UP_S:
            yield from runner.end()
        elif now - self._sent_s > RESEND_S and not runner.gate.latched_stop:
            # Subscribers of the other images can appear after the frame was made.
            *others, image = run.frame
            made = {message.topic_name for message in others}
            run.frame = (*others, *run.episode.view.more(runner.header(run), made), image)
            runner.gate.expect_anybody()
            self._sent_s = self._clock()
            self.resent += 1
            yield from run.frame
