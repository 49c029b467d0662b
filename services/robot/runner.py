"""Runner of a robot's episodes: requests, commands and clock readings in, messages out."""

import logging
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Final, Generic, TypeVar

from schemas.base import NO_EPISODE, Message
from schemas.camera import CompressedImage, DepthImage
from schemas.command import Command, CommandApplied
from schemas.episode import Episode as EpisodeEvent
from schemas.episode import EventName, Outcome
from schemas.heartbeat import Heartbeat, Pulse
from schemas.rpc import (
    ArmRequest,
    CancelRequest,
    CarryRequest,
    EndRequest,
    Mode,
    ResetReply,
    ResetRequest,
    ResumeRequest,
    TaskRequest,
)
from services.kit.cameras import camera_info
from services.kit.jpeg import decode_jpeg, encode_jpeg, jpeg_size
from services.kit.node import ServiceError
from services.robot import radio
from services.robot.body import Body, Carriable, OdometryReading, View
from services.robot.cancelling import CancelledError, Cancelling
from services.robot.clock import CLOCKS, Clocks
from services.robot.episode import Ended, RunningEpisode
from services.robot.gate import Applied, CommandGate
from services.robot.guard import guard_of
from services.robot.loop import check_stopping
from services.robot.messages import imu_message, odometry_message
from services.robot.pace import Pace, Paces, RealTime, Running
from services.robot.task import Task
from services.robot.wheels import WheelCheck

#: Silence of the client that began an episode, after which another client can begin one; four of its
#: heartbeats.
CLIENT_S: Final = 2.0
# Number of frames whose readiness is stored; commands for older frames are stale.
READY_KEPT: Final = 10
# Events before the end; the goal has its own event when it is first reached.
_ENDING_EVENTS: Final[dict[Outcome, EventName]] = {
    "collision": "collision", "timeout": "timed_out", "missed": "timed_out"
}  # fmt: skip
_log = logging.getLogger("robot")
V = TypeVar("V", bound=View)


class EpisodeRunner(Generic[V]):
    """Runs the episodes of one robot.

    ``session`` distinguishes this process's episodes from those of an earlier process. ``offer``,
    ``hear``, ``pulse``, ``cancel`` and the gate's ``stop`` are thread-safe; the rest belongs to one
    thread. ``paces`` are the modes besides real time.
    """

    def __init__(
        self,
        body: Body[V],
        task: Task[V],
        gate: CommandGate,
        robot: str,
        session: str,
        *,
        paces: Paces[V] | None = None,
        clocks: Clocks = CLOCKS,
    ) -> None:
        self.body = body
        self.gate = gate
        self.wake: Callable[[], None] = lambda: None  # Requests a ``poll``; must return at once.
        # Whether stops or commands might not reach the robot.
        self.deaf: Callable[[], bool] = lambda: False
        self.frame_s = body.frame_s  # Minimum time between two frames in real time.
        self.task = task
        self.radio = False  # Whether the driver is reached by radio; see `services.robot.radio`.
        # JPEG quality of published images; None: as the camera provides them.
        self.jpeg_quality: int | None = None
        self._robot = robot
        self.session = session
        self._paces: dict[Mode, Callable[[], Pace[V]]] = {
            "realtime": lambda: RealTime(
                gate, body, clocks.monotonic_s, self.wake, self.frame_s, self.deaf, clocks.hold
            ),
            **(paces or {}),
        }
        self._clocks = clocks
        self._cancelling = Cancelling()
        self._count = 0
        self.running: Running[V] | None = None
        #: Error that ended the last episode, one line; None without one.
        self.fault: str | None = None

    # -- requests ----------------------------------------------------------------------------------

    def arm(self, request: ArmRequest) -> None:
        """Release a latched stop; ServiceError if denied, or for another stop."""
        self._unless(self.gate.arm(request.stop, request.session))

    def resume(self, request: ResumeRequest) -> None:
        """Let the driver continue after a person took over; ServiceError if denied."""
        # Between two episodes a person cannot have missed a frame, and a new person has received
        # none.
        episode = None if self.running is None else request.episode
        self._unless(self.gate.resume(episode, request.tick, request.session))

    def check_reset(self, request: ResetRequest) -> None:
        """Refuse an episode that must not begin.

        Raises
        ------
        ServiceError
            While a stop is latched, a person has taken over, another client's episode runs, or an
            operator denies it; or if the mode is unsupported.
        """
        if request.mode not in self._paces:
            raise ServiceError(f"{self.body.name}: unsupported mode {request.mode}; use realtime")
        if self.gate.latched_stop:
            cause = {
                "not_armed": "the robot is not armed; arm it",
                "emergency_stop": "an emergency stop is latched; release it",
                "operator_lost": "the operator was lost; arm the robot",
                "wheels": "the odometry contradicts the commands; inspect the wheels, then arm the robot",
                "fault": "the robot's body has failed; inspect it, then arm it",
            }[self.gate.stop_cause or "not_armed"]
            raise ServiceError(f"{cause}, from the console's page or smal teleop (n)")
        if self.gate.taken_over or request.driver == "teleop":
            self._unless(self.gate.not_theirs(request.session))
        if self.gate.taken_over and request.driver != "teleop":
            raise ServiceError(
                "a person has taken over; resume, from the console's page or smal teleop (r)"
            )
        run = self.running
        if (
            run is not None
            and request.session != run.request.session
            and not (self.gate.taken_over and request.driver == "teleop")
            and self._clocks.monotonic_s() - run.client_s <= CLIENT_S
        ):
            raise ServiceError(
                f"episode {run.id} belongs to another client; take over from its driver, or end it"
            )

    def reset(self, request: ResetRequest) -> tuple[ResetReply, list[Message]]:
        """End the running episode and begin the next; return the reply and the messages to publish."""
        self.check_reset(request)
        messages = self.end()
        self.fault = None
        pace = self._paces[request.mode]()
        self._count += 1
        name = f"{request.name or f'{request.purpose}-{request.seed}'}-{self.session}-{self._count}"
        # Commands from before this line expire.
        self.gate.begin(name, request.driver)
        try:
            with self._cancelling.beginning(request.session):
                episode = RunningEpisode(self.body, self.task, request)
        except CancelledError as error:
            raise ServiceError(
                f"{error}; the robot is in {self.body.name}, without an episode"
            ) from None
        # Another world can have another robot.
        check_stopping(self.body)
        self.gate.guard = guard_of(self.body)
        self.gate.kinematics = self.body.kinematics
        self.gate.wheels = WheelCheck(self.body.kinematics, self.frame_s)
        # The start has the time of the first frame.
        begun_s = pace.captured_s(episode.view, 0)
        begun_ns = self._clocks.wall_ns() - round((pace.gate_s(0) - begun_s) * 1e9)
        self.running = run = Running(
            name, episode, pace, begun_s, begun_ns, begun_ns, client_s=self._clocks.monotonic_s()
        )
        messages.append(self._event(run, "started"))
        try:
            messages.extend(self._frame(run))
            pace.begin()
        except Exception:
            self.running = None  # The caller receives the error instead of an episode.
            raise
        reply = ResetReply(
            episode=name,
            world=self.body.name,
            speed_m_s=self.body.kinematics.speed_m_s,
            car=self.body.kinematics.radius_m > 0.0,
            route=episode.beginning.route,
            found_m=episode.beginning.found_m,
            victim=episode.beginning.victim,
            things=episode.beginning.things,
        )
        return reply, messages

    def carry(self, request: CarryRequest) -> None:
        """Carry a simulated robot elsewhere.

        Raises
        ------
        ServiceError
            For another body, during a drive, if an operator denies it, or if the place is not free.
        """
        body = self._carriable(request.session)
        run = self.running
        if run is not None and run.request.purpose != "run":
            raise ServiceError("not carried: this drive would teach a wrong way; end it first")
        body.carry(request.x_m, request.y_m, request.heading_rad)
        if run is not None:
            run.carried = True

    def choose_task(self, request: TaskRequest) -> None:
        """Choose start and goal in the world of a simulated robot; ServiceError as for ``carry``."""
        body = self._carriable(request.session)
        if self.running is not None:
            raise ServiceError("start and goal not chosen: an episode runs; end it first")
        body.choose_task(request.start, request.goal)

    def _carriable(self, session: str) -> Carriable:
        body: object = self.body
        if not isinstance(body, Carriable):
            raise ServiceError(
                f"{self.body.name}: unsupported; only a simulated robot can be carried"
            )
        self._unless(self.gate.not_theirs(session))
        return body

    def cancel(self, request: CancelRequest) -> None:
        """Cancel an episode that is beginning; thread-safe, ServiceError if idle or denied."""
        self._cancelling.cancel(request.session, self.gate.operator)

    def end_by(self, request: EndRequest) -> list[Message]:
        """End the running episode on request; ServiceError for another episode, or if denied."""
        run = self.running
        if run is None or run.id != request.episode:
            raise ServiceError(f"episode {request.episode} is not running")
        driven = self.gate.taken_over or run.request.driver == "teleop"
        if request.found or (driven and request.session != run.request.session):
            self._unless(self.gate.not_theirs(request.session))
        ended = run.episode.end(None if request.found else request.said, told=request.found)
        return self.end(ended._replace(box=request.box if request.found else None))

    def end(self, ended: Ended | None = None) -> list[Message]:
        """End the running episode, by default without a report."""
        run = self.running
        if run is None:
            return []
        self.running = None
        run.pace.end()
        return [self._event(run, "ended", ended or run.episode.end())]

    # -- events ------------------------------------------------------------------------------------

    def offer(self, command: Command) -> None:
        """Offer a command to the gate."""
        run = self.running
        if run is not None and command.episode == run.id:
            run.window.answered(command.tick)
        refusal = self.gate.offer(
            command, self._clocks.monotonic_s() if run is None else run.pace.gate_s(run.tick)
        )
        if run is None or refusal is not None or command.source == "emergency_stop":
            return
        ready_s = run.ready_s.get(command.tick)
        if ready_s is not None:
            run.latency_s[command.source] = self._clocks.monotonic_s() - ready_s

    def hear(self, beat: Heartbeat) -> None:
        """Take a heartbeat."""
        now = self._clocks.monotonic_s()
        run = self.running
        if beat.answers is not None:
            self.gate.hear(beat, now)
        if (
            run is not None
            and beat.session == run.request.session
            and beat.sequence > run.client_beat
        ):
            run.client_beat = beat.sequence
            run.client_s = now if beat.present else -math.inf

    def pulse(self) -> Pulse:
        """Return the robot's next pulse."""
        # While a world opens, this is the only check of the operator's presence.
        self.gate.watch(self._clocks.monotonic_s())
        run = self.running
        nowhere = Message(robot=self._robot, episode=NO_EPISODE, tick=0, stamp_ns=0)
        return Pulse.after(
            nowhere if run is None else self.header(run),
            session=self.session,
            number=self.gate.pulse(self._clocks.monotonic_s()),
            latched_stop=self.gate.latched_stop,
            stop_cause=self.gate.stop_cause,
        )

    def poll(self) -> Iterator[Message]:
        """Advance the time: take due frames and report changes of motion."""
        self.gate.watch(self._clocks.monotonic_s())
        if self.running is None:
            return
        try:
            yield from self.running.pace.poll(self, self.running)
        except Exception as error:
            # An interrupted frame cannot be answered or repeated, so the episode cannot continue.
            known = isinstance(error, ServiceError)
            self.fault = str(error) if known else "internal error; see the log of robot"
            yield from self.end(Ended("aborted"))
            raise

    def next_frame(self, run: Running[V]) -> Iterator[Message]:
        """Take the next frame, and end the episode if it ends with it."""
        stands = bool(self.gate.latched_stop)
        run.episode.next_frame(untimed=stands or self.gate.taken_over)
        run.said = 0
        yield from self._frame(run)
        outcome = run.episode.outcome
        if outcome is None:
            return
        if outcome in _ENDING_EVENTS:
            yield self._event(run, _ENDING_EVENTS[outcome])
        yield from self.end(Ended(outcome, "task" if outcome == "found" else None))

    def _guard_looks(self, view: V, captured_s: float) -> None:
        """Pass a view to the guard if the odometry is consistent."""
        followed = view.odometry is not None and self._follows(view.odometry, captured_s)
        if view.odometry is not None and followed and self.gate.guard is not None:
            self.gate.guard.look(view.depth, view.odometry[:3], captured_s)

    def _camera_info(self, frame: Sequence[Message]) -> Iterator[Message]:
        image = frame[-1] if frame else None
        if self.body.camera is not None and isinstance(image, CompressedImage):
            yield camera_info(image, self.body.camera, image.width, image.height)

    def _frame(self, run: Running[V]) -> Iterator[Message]:
        view = run.episode.view
        tick = run.tick
        captured_s = run.pace.captured_s(view, tick)
        self.gate.captured(tick, captured_s)
        self._guard_looks(view, captured_s)
        run.stamp_ns = run.begun_ns + round((captured_s - run.begun_s) * 1e9)
        header = self.header(run)
        answers = run.request.driver == "policy" and not self.gate.taken_over
        if self.radio and answers and not run.window.takes(tick, captured_s):
            run.frame = ()
        else:
            run.frame = tuple(self._pictures(view, header))
        run.ready_s = {t: at for t, at in run.ready_s.items() if t > tick - READY_KEPT} | {
            tick: self._clocks.monotonic_s()
        }
        if tick == 0:
            yield from self._camera_info(run.frame)
        if view.odometry is not None:
            yield odometry_message(header, view.odometry)
        if view.imu is not None:
            yield imu_message(header, view.imu)
        yield from run.frame
        if run.carried or (tick and tick == run.request.kidnap_tick):
            run.carried = False
            yield self._event(run, "kidnapped")
        if run.episode.reached and not run.found:
            run.found = True
            yield self._event(run, "victim_found")

    def _follows(self, odometry: OdometryReading, captured_s: float) -> bool:
        """Return whether the odometry follows the commands; otherwise stop the robot."""
        wheels = self.gate.wheels
        contradiction = None if wheels is None else wheels.read(odometry[:3], captured_s)
        if contradiction is not None:
            self.gate.stop("wheels")
            _log.error("%s: the robot stands until it is armed again", contradiction)
        return contradiction is None

    def _pictures(self, view: V, header: Message) -> Iterator[Message]:
        """Yield the messages that the driver answers; the colour image comes last."""
        for message in view.more(header):
            yield (
                radio.coarse(message) if self.radio and isinstance(message, DepthImage) else message
            )
        jpeg = (
            view.jpeg
            if self.jpeg_quality is None
            else encode_jpeg(decode_jpeg(view.jpeg), self.jpeg_quality)
        )
        width, height = jpeg_size(jpeg) or (0, 0)
        yield CompressedImage.after(header, width=width, height=height, data=jpeg)

    def tell(self, run: Running[V], applied: Applied) -> CommandApplied:
        """Return the record of the robot's motion, and store it to report only changes."""
        run.applied = applied
        sequence = run.said
        run.said = run.said + 1
        latency_s = None if applied.source is None else run.latency_s.get(applied.source)
        return CommandApplied.after(
            self.header(run),
            sequence=sequence,
            atom=applied.velocity.atom(),
            **applied.velocity._asdict(),
            source=applied.source,
            reason=applied.reason,
            answered_tick=applied.answered_tick,
            latency_ns=None if latency_s is None else round(latency_s * 1e9),
            delay_ns=None if applied.answered_tick is None else round(run.pace.delay_s * 1e9),
            latched_stop=self.gate.latched_stop,
            stop_cause=self.gate.stop_cause,
            refused=sum(self.gate.refused.values()),
        )

    def header(self, run: Running[V]) -> Message:
        """Return the common header of the last frame's messages."""
        return Message(robot=self._robot, episode=run.id, tick=run.tick, stamp_ns=run.stamp_ns)

    def _event(self, run: Running[V], name: EventName, ended: Ended | None = None) -> EpisodeEvent:
        return EpisodeEvent.after(
            self.header(run),
            event=name,
            purpose=run.request.purpose,
            driver=run.request.driver,
            world=self.body.name,
            seed=run.request.seed,
            goal=run.request.goal,
            **({} if ended is None else ended._asdict()),
        )

    @staticmethod
    def _unless(refusal: str | None) -> None:
        if refusal is not None:
            raise ServiceError(refusal)
