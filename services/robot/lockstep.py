"""Lockstep pace: the world advances with each answered frame, at the speed of any machine.

Any simulator is a body here: `SteppedBody` needs its start, its step and its view.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from schemas.base import KEYS, STANDING, TICK_S, Atom, Message, Velocity
from schemas.motion import TruePose
from schemas.rpc import ResetRequest
from services.kit.errors import foreign_error, out_of_memory
from services.kit.jpeg import encode_jpeg
from services.kit.node import Detail, Node, ServiceError
from services.kit.process import configure_logging, read_settings, run_service
from services.robot.body import Beginning, Body, ImuReading, Kinematics, OdometryReading, View
from services.robot.clock import SimulatedClock, now_s
from services.robot.episode import RunningEpisode
from services.robot.gate import bounded
from services.robot.guard import guard_of
from services.robot.pace import Paces, Running, Teller
from services.robot.service import ROBOT, RobotSettings, serve_robot
from services.robot.task import Task
from services.robot.wheels import WheelCheck
from smal.camera import Camera
from smal.movement import is_pose
from smal.obstacles.clearance import Mount

#: Timeouts of an answer, seconds: resend the frame (a message can be lost), then end the episode.
RESEND_S: Final = 2.0
GIVE_UP_S: Final = 30.0
V = TypeVar("V", bound=View)
V_co = TypeVar("V_co", bound=View, covariant=True)


class Steppable(Body[V_co], Protocol[V_co]):
    """A body whose world can wait."""

    def advance(self, velocity: Velocity, duration_s: float) -> None:
        """Move the robot at a velocity for a duration, which is its ``frame_s``."""


class PosedView(View, Protocol):
    """A view of a simulator, which knows where the robot is."""

    @property
    def true_pose(self) -> tuple[float, float, float]:
        """Ground truth: x, y in metres, heading in radians."""


class SteppedEpisode(RunningEpisode[V]):
    """An episode in this process, with the same poses as an episode over messages."""

    def __init__(self, body: Steppable[V], task: Task[V], request: ResetRequest) -> None:
        super().__init__(body, task, request)
        self._steppable = body
        self._guard = guard_of(body)
        self._wheels = WheelCheck(body.kinematics, body.frame_s)
        #: Stop cause that holds until the end, after contradicting sensors.
        self.contradiction: str | None = None

    @property
    def kinematics(self) -> Kinematics:
        """Limits of the robot's motion."""
        return self._steppable.kinematics

    @property
    def mount(self) -> Mount | None:
        """Position of the depth camera."""
        return self._steppable.mount

    def step(self, asked: Atom | Velocity) -> V:
        """Execute an action as far as the gate permits, and return the next view."""
        frame_s = self._steppable.frame_s
        now_s = self.tick * frame_s
        self._read(now_s)
        wanted = KEYS[asked] if isinstance(asked, str) else asked
        may, _ = bounded(
            STANDING if self.contradiction else wanted, self.kinematics, self._guard, now_s
        )
        self._wheels.told(may, now_s)
        _advance(self._steppable, may)
        return self.next_frame()

    def _read(self, now_s: float) -> None:
        """Compare the odometry with the commands, and pass the depth image to the guard."""
        if self.view.odometry is None:
            return
        wheels = self.view.odometry[:3]
        self.contradiction = self.contradiction or self._wheels.read(wheels, now_s)
        if self._guard is not None and self.contradiction is None:
            self._guard.look(self.view.depth, wheels, now_s)


class Lockstep(Generic[V]):
    """Pace of a robot whose world waits for commands; `clock` times the answers."""

    delay_s = 0.0  # The world waits.

    def __init__(self, body: Steppable[V], clock: Callable[[], float] = now_s) -> None:
        self._body = body
        self._clock = clock
        self._sent_s = clock()
        self.resent = 0

    def gate_s(self, tick: int) -> float:
        """Return simulated time, so that a slow machine does not make commands stale."""
        return tick * self._body.frame_s

    def captured_s(self, _view: V, tick: int) -> float:
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

    def poll(self, runner: Teller[V], run: Running[V]) -> Iterator[Message]:
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
            _advance(self._body, applied.velocity)
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


@dataclass(frozen=True, eq=False)
class StepView:
    """View of a `SteppedBody`."""

    image: NDArray[np.uint8]  # Camera image (height, width, 3), RGB.
    contact: bool = False
    reached: bool = False  # Whether the goal is reached, by the simulator.
    odometry: OdometryReading | None = None
    pose: tuple[float, float, float] | None = None
    """Ground truth, if known: metres and radians; recorded, and shown on the page."""
    imu: tuple[ImuReading, ...] | None = None
    depth: NDArray[np.float32] | None = None
    captured_s: float = field(default_factory=now_s)

    @cached_property
    def jpeg(self) -> bytes:
        """Camera image as JPEG."""
        return encode_jpeg(self.image)

    @property
    def true_pose(self) -> tuple[float, float, float]:
        """Ground truth; ValueError if the simulator does not report it."""
        if self.pose is None:
            raise ValueError("the view has no pose; the simulator must report the true pose")
        return self.pose

    def more(self, header: Message, made: Collection[str] = ()) -> Iterator[Message]:
        """Yield the true pose, if known."""
        if self.pose is not None and TruePose.topic not in made:
            x_m, y_m, heading = map(float, self.pose)
            within = math.remainder(heading, math.tau)
            yield TruePose.after(header, x_m=x_m, y_m=y_m, heading_rad=within)


class SteppedBody(ABC):
    """A simulator as a body: subclasses set `name` and `kinematics`, and implement three methods.

    An error of these methods, or an invalid view, is a ServiceError of one line. Time stands
    between two frames. In real time the world takes a step with each frame.
    """

    name: str
    kinematics: Kinematics
    frame_s: float = TICK_S
    #: Names of the `services.robot.body.CONDITIONS` that `start` fulfils; others are refused.
    conditions: Collection[str] = ()
    camera: Camera | None = None
    mount: Mount | None = None
    watchdog_s = 0.2
    braking_s = 0.0
    _realtime = False
    _held: tuple[Velocity, float] = (STANDING, 0.0)  # The last command and its time.
    _view: StepView | None = None

    @abstractmethod
    def start(self, request: ResetRequest) -> Beginning:
        """Prepare an episode; ServiceError if that is impossible."""

    @abstractmethod
    def advance(self, velocity: Velocity, duration_s: float) -> None:
        """Move the robot at a velocity for a duration, which is `frame_s`."""

    @abstractmethod
    def observe(self) -> StepView:
        """Return the view of this moment."""

    def begin(self, request: ResetRequest) -> Beginning:
        """Prepare an episode."""
        self.check()
        self._realtime = request.mode == "realtime"
        self._held = STANDING, now_s()
        with _in_a_line(self, "start"):
            beginning = self.start(request)
        if not isinstance(beginning, Beginning):
            raise ServiceError(f"{self.name}: start must return a Beginning, got {beginning!r:.60}")
        return beginning

    def check(self) -> None:
        """Raise ServiceError if its name, its speeds or its frame time are invalid."""
        kind = type(self).__name__
        if not isinstance(getattr(self, "name", None), str):
            raise ServiceError(f"{kind}: name not found; set it to a text")
        if not isinstance(getattr(self, "kinematics", None), Kinematics):
            raise ServiceError(f"{self.name}: kinematics not found; set it to a Kinematics")
        numbers = {
            "frame_s": self.frame_s,
            "kinematics.speed_m_s": self.kinematics.speed_m_s,
            "kinematics.turn_rate_rad_s": self.kinematics.turn_rate_rad_s,
        }
        for name, value in numbers.items():
            if not 0.0 < value < math.inf:
                raise ServiceError(f"{self.name}: {name} must be greater than 0, got {value!r:.60}")

    def drive(self, velocity: Velocity) -> Velocity:
        """Hold a velocity for the next frames; in lockstep `advance` alone moves the world."""
        self._held = velocity, now_s()
        return velocity

    def stand(self) -> None:
        """Stop the robot."""
        self.drive(STANDING)

    def look(self, tick: int) -> StepView:
        """Return the view of a tick; in real time after a step with the last command."""
        if self._realtime and tick:
            velocity, told_s = self._held
            silent = now_s() - told_s > self.watchdog_s
            _advance(self, STANDING if silent else velocity)
        with _in_a_line(self, "observe"):
            view = self.observe()
        _check_view(self.name, view)
        self._view = view
        return view

    def peek(self) -> bytes | None:
        """Return the last image as JPEG; None before the first episode."""
        return None if self._view is None else self._view.jpeg

    def detail(self) -> Detail:
        """Return no further status."""
        return {}


@contextmanager
def _in_a_line(body: object, method: str) -> Iterator[None]:
    """Raise an error of another simulator as a ServiceError, with its file and line."""
    try:
        yield
    except ServiceError:
        raise
    except Exception as error:
        if out_of_memory(error) or not isinstance(body, SteppedBody):
            raise
        raise ServiceError(f"{body.name}: {method} failed: {foreign_error(error)}") from error


def _advance(body: Steppable[V], velocity: Velocity) -> None:
    with _in_a_line(body, "advance"):
        body.advance(velocity, body.frame_s)


def _check_view(name: str, view: StepView) -> None:
    """Raise ServiceError if a view of another simulator is invalid."""
    if not isinstance(view, StepView):
        raise ServiceError(f"{name}: observe must return a StepView, got {view!r:.60}")
    image: object = view.image
    if not isinstance(image, np.ndarray):
        raise ServiceError(f"{name}: the image must be an array, got {image!r:.60}")
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or not image.size:
        raise ServiceError(
            f"{name}: {image.dtype} {image.shape} is not an RGB image; "
            "give uint8 (height, width, 3)"
        )
    if view.pose is not None and not is_pose(view.pose):
        raise ServiceError(
            f"{name}: the pose must be three finite numbers, x, y in metres and heading in "
            f"radians, got {view.pose!r:.60}"
        )
    if view.odometry is not None and not is_pose(view.odometry[:3]):
        raise ServiceError(
            f"{name}: the odometry must be an OdometryReading of finite numbers, "
            f"got {view.odometry!r:.60}"
        )


class SimulatorsTask(Task[StepView]):
    """Task whose goal the simulator judges."""

    def reached(self, view: StepView, goal: str) -> bool:
        """Return whether the simulator has reported the goal."""
        return view.reached


class SteppedSettings(RobotSettings):
    """Settings of a simulator behind `smal up --robot-module`."""

    attended: bool = False
    """Whether the robot moves only while an operator is present"""


def serve_body(make: Callable[[], SteppedBody], task: Task[StepView] | None = None) -> None:
    """Run a body on the bus, as the program that `smal up --robot-module` starts.

    Parameters
    ----------
    make : callable
        Creates the body.
    task : Task, optional
        Judge of the goal; by default the simulator (`StepView.reached`).
    """

    def serve() -> None:
        settings = read_settings(SteppedSettings, ROBOT)
        configure_logging(settings.log_level)

        def open_body(_node: Node) -> tuple[SteppedBody, Paces[StepView]]:
            try:
                body = make()
            except Exception as error:
                if out_of_memory(error):
                    raise
                raise ServiceError(f"{make!r:.80}: {foreign_error(error)}") from None
            body.check()
            return body, {"lockstep": lambda: Lockstep(body)}

        serve_robot(settings, open_body, task or SimulatorsTask(), clocks=SimulatedClock().clocks)

    run_service(ROBOT, serve)
