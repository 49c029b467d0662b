"""One simulated robot, episode after episode: what happens when a command comes, or when time passes.

Pure: it takes commands and clock readings and gives messages. In lockstep the next frame is made when the driver has
answered the last one; in real time the clock decides.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from schemas.base import Atom, Message, Source
from schemas.command import Command, CommandApplied
from schemas.compressed_image import CompressedImage
from schemas.episode import Episode, EventName, Outcome, Purpose
from schemas.image import Image
from schemas.pose import Pose
from schemas.rpc import ResetReply, ResetRequest
from schemas.topics import DEPTH, OVERHEAD, Topic
from services.kit.jpeg import encode_jpeg
from services.robot.clock import now_s
from services.robot.gate import Applied, CommandGate
from services.robot.outcome import outcome_of
from services.simulator.base import STEP_S
from services.simulator.drive import TICK_S
from services.simulator.sensors import ImuReading, OdometryReading
from services.simulator.sensors.messages import (
    camera_info,
    depth_message,
    imu_message,
    odometry_message,
    overhead_message,
)
from services.simulator.world.place import OverheadMount
from services.simulator.world.place import Pose as PlanarPose

#: Lockstep: seconds without an answer after which a frame is sent again (a message may be lost), and given up.
RESEND_S: Final = 2.0
GIVE_UP_S: Final = 30.0
#: Frames whose readiness is remembered; an older one's command is stale anyway.
READY_KEPT: Final = 10
_EPS_S: Final = 1e-9
# What is told of before the end is; that the victim is found is told when it is first seen.
_ENDING_EVENTS: Final[dict[Outcome, EventName]] = {"collision": "collision", "timeout": "timed_out"}


class World(Protocol):
    """What an episode needs of the simulated world; see ``services.simulator.simulation``."""

    @property
    def name(self) -> str:
        """Name of the world."""

    @property
    def speed_m_s(self) -> float:
        """The robot's nominal speed."""

    @property
    def found_m(self) -> float:
        """How near the victim counts as found, if it is seen."""

    def reset(self, seed: int, purpose: Purpose, *, anywhere: bool = False) -> PlanarPose:
        """Put the robot at a seeded start."""

    def carry_away(self) -> PlanarPose:
        """Put the robot anywhere beside the way."""

    def advance(self, atom: Atom, speed: float, duration_s: float) -> None:
        """Move the robot."""

    def render(self) -> NDArray[np.uint8]:
        """Return the camera image, (height, width, 3)."""

    @property
    def focal_px(self) -> float:
        """Focal length of the camera in pixels."""

    def depth_m(self) -> NDArray[np.float32]:
        """Return the distance of each pixel along the camera's axis, (height, width) metres or `inf`."""

    @property
    def overhead_mount(self) -> OverheadMount | None:
        """How the camera above the scene hangs, if there is one."""

    def overhead(self) -> NDArray[np.uint8]:
        """Return its image, (height, width, 3)."""

    def odometry(self) -> OdometryReading:
        """Return where the wheels say that the robot is; asked once a frame."""

    def imu(self) -> tuple[ImuReading, ...]:
        """Return the inertial readings since this was last asked."""

    def victim_found(self) -> bool:
        """Whether the victim is near and in view."""

    def route(self) -> NDArray[np.float64]:
        """Return way points from the robot to the victim, (k, 2)."""

    @property
    def pose(self) -> PlanarPose:
        """Where the robot is."""

    @property
    def collided(self) -> bool:
        """Whether the robot has hit something."""


@dataclass
class _Running:
    """The state of the running episode."""

    id: str
    request: ResetRequest
    #: When the world's clock would have stood at zero (moved where rendering cannot keep up), and when it began.
    start_s: float
    begun_s: float
    begun_ns: int
    tick: int = 0
    #: When the last frame was captured; the wall clock is read once an episode, since it may be set meanwhile.
    stamp_ns: int = 0
    moved_s: float = 0.0
    #: Whether the victim has been found at all, and whether it is in the last frame.
    found: bool = False
    in_view: bool = False
    applied: Applied | None = None
    #: How many times it was said in this tick what moves the robot.
    said: int = 0
    sent_s: float = 0.0
    frame: tuple[Message, ...] = ()
    #: When recent frames were ready to be sent, and how long each source's last accepted command took from then.
    ready_s: dict[int, float] = field(default_factory=dict)
    latency_s: dict[Source, float] = field(default_factory=dict)


class EpisodeRunner:
    """Runs episodes of one robot in one world.

    Parameters
    ----------
    world
        The simulated world.
    robot
        Robot id.
    session
        Distinguishes this process's episodes from an earlier one's.
    clock, wall_clock_ns
        Monotonic seconds, and nanoseconds since 1970.
    wanted
        Whether anybody listens to a topic; asked at every frame for those whose messages are costly.
    """

    def __init__(
        self,
        world: World,
        robot: str,
        session: str,
        clock: Callable[[], float] = now_s,
        wall_clock_ns: Callable[[], int] = time.time_ns,
        wanted: Callable[[Topic], bool] = lambda _topic: False,
    ) -> None:
        self._world = world
        self._clock = clock
        self._wall_clock_ns = wall_clock_ns
        self._wanted = wanted
        for topic in (DEPTH, OVERHEAD):
            # Who listens becomes known a moment after it was asked for the first time: the first frame is too late.
            wanted(topic)
        self._robot = robot
        self._session = session
        self._count = 0
        self.gate = CommandGate()
        self._running: _Running | None = None
        self.slow_ticks = 0
        self.resent = 0
        self.world_name = world.name

    @property
    def running(self) -> _Running | None:
        """The running episode, if any."""
        return self._running

    def reset(self, request: ResetRequest) -> tuple[ResetReply, list[Message]]:
        """End the running episode, if any, and begin the next one.

        Returns
        -------
        reply, messages
            The answer to the caller, and what to publish: the old episode's end, the new one's start, its frame 0.
        """
        messages = self.end(None)
        self._world.reset(request.seed, request.purpose, anywhere=request.start == "anywhere")
        self._count += 1
        episode = f"{request.purpose}-{request.seed}-{self._session}-{self._count}"
        now_s, now_ns = self._clock(), self._wall_clock_ns()
        self._running = run = _Running(episode, request, now_s, now_s, now_ns, stamp_ns=now_ns)
        self.gate.begin(episode, request.driver, release_stop=request.release_emergency_stop)
        route = tuple((float(x), float(y)) for x, y in self._world.route())
        messages.append(self._event("started"))
        try:
            messages.extend(self._capture(run))
        except Exception:
            self._running = None  # who asked is told that there is none
            raise
        reply = ResetReply(
            episode=episode,
            world=self._world.name,
            route=route,
            speed_m_s=self._world.speed_m_s,
            found_m=self._world.found_m,
        )
        return reply, messages

    def end(self, outcome: Outcome | None) -> list[Message]:
        """End the running episode; without an outcome it is ``found`` if the last frame shows the victim, near.

        That frame is what a drive teaches as its goal; one that passed the victim and went on is ``aborted``.
        """
        if self._running is None:
            return []
        outcome = outcome or ("found" if self._running.in_view else "aborted")
        message = self._event("ended", outcome)
        self._running = None
        return [message]

    def offer(self, command: Command) -> Iterator[Message]:
        """Take a command; in lockstep the world moves on when the driver has answered.

        While an emergency stop is latched it does not: the robot stands, and nothing is rendered.
        """
        run = self._running
        if run is None:
            return
        now_s = self._gate_s(run)
        refusal = self.gate.offer(command, now_s)
        if refusal is None and command.source != "emergency_stop":
            run.latency_s[command.source] = self._clock() - run.ready_s[command.tick]
        if (
            run.request.mode == "lockstep"
            and not self.gate.emergency_stop
            and self.gate.answered(run.request.driver, run.tick)
        ):
            applied = self.gate.applied(now_s)
            yield self._apply(run, applied)
            if self.gate.applied(now_s).reason == "emergency_stop":
                return  # it came while that was being said
            self._world.advance(applied.atom, applied.speed, TICK_S)
            yield from self._next_tick(run)

    def poll(self) -> Iterator[Message]:
        """Let time pass: in real time the robot moves, in lockstep a frame without an answer is sent again."""
        run = self._running
        if run is None:
            return
        if run.request.mode == "lockstep":
            yield from self._await_answer(run)
            return
        now_s = self._clock()
        lag_s = now_s - run.start_s - run.moved_s
        if lag_s > 2 * TICK_S:
            # Rendering is slower than real time: the world's clock waits, so that no frame is skipped.
            run.start_s += lag_s - TICK_S
            self.slow_ticks += 1
        while run is self._running and run.start_s + run.moved_s + STEP_S <= now_s:
            # By the clock, not by the world's time, which lags behind it: a stale command must move nothing.
            applied = self.gate.applied(self._clock())
            if run.applied is None or _what(applied) != _what(run.applied):
                yield self._apply(run, applied)
            self._world.advance(applied.atom, applied.speed, STEP_S)
            run.moved_s += STEP_S
            if run.moved_s >= (run.tick + 1) * TICK_S - _EPS_S:
                yield from self._next_tick(run)
                return

    def _gate_s(self, run: _Running) -> float:
        """Read the gate's clock: in lockstep the simulated one, so that a slow machine makes no command stale."""
        return run.tick * TICK_S if run.request.mode == "lockstep" else self._clock()

    def _await_answer(self, run: _Running) -> Iterator[Message]:
        now_s = self._clock()
        applied = self.gate.applied(self._gate_s(run))
        if applied.reason == "emergency_stop" and applied != run.applied:
            yield self._apply(run, applied)
        if now_s - run.ready_s[run.tick] > GIVE_UP_S:
            yield from self.end(None)
        elif now_s - run.sent_s > RESEND_S and not self.gate.emergency_stop:
            # Who wants the other images may have come, or have become known, only after the frame was made.
            *others, image = run.frame
            run.frame = (*others, *self._wanted_images(self._header(run), others), image)
            run.sent_s = self._clock()
            self.resent += 1
            yield from run.frame

    def _next_tick(self, run: _Running) -> Iterator[Message]:
        try:
            yield from self._go_on(run)
        except Exception:
            # Half a frame cannot be answered: nobody would ever go on.
            yield from self.end("aborted")
            raise

    def _go_on(self, run: _Running) -> Iterator[Message]:
        run.tick += 1
        run.said = 0
        if run.tick == run.request.kidnap_tick:
            self._world.carry_away()
        yield from self._capture(run)
        if run.request.mode == "realtime":
            yield self._apply(run, self.gate.applied(self._clock()))
        outcome = outcome_of(
            collided=self._world.collided,
            in_view=run.in_view,
            purpose=run.request.purpose,
            timed_out=run.tick >= run.request.max_ticks,
        )
        if outcome is None:
            return
        if outcome in _ENDING_EVENTS:
            yield self._event(_ENDING_EVENTS[outcome])
        yield from self.end(outcome)

    def _capture(self, run: _Running) -> Iterator[Message]:
        pose = self._world.pose
        captured_s = self._gate_s(run)
        self.gate.captured(run.tick, captured_s)
        elapsed_s = captured_s if run.request.mode == "lockstep" else captured_s - run.begun_s
        run.stamp_ns = run.begun_ns + round(elapsed_s * 1e9)
        header = self._header(run)
        image = self._world.render()
        height, width, _ = image.shape
        # The colour image comes last: it is what the driver waits for.
        run.frame = (
            Pose.after(header, x_m=pose.x, y_m=pose.y, heading_rad=pose.heading),
            *self._wanted_images(header),
            Image.after(header, width=width, height=height, data=image.tobytes()),
        )
        run.sent_s = self._clock()
        run.ready_s = {tick: at for tick, at in run.ready_s.items() if tick > run.tick - READY_KEPT}
        run.ready_s[run.tick] = run.sent_s
        if run.tick == 0:
            yield camera_info(header, image, self._world.focal_px)
        yield odometry_message(header, self._world.odometry())
        yield imu_message(header, self._world.imu())
        yield from run.frame
        # After the raw image, so that its features are worked on meanwhile.
        yield CompressedImage.after(header, width=width, height=height, data=encode_jpeg(image))
        run.in_view = self._world.victim_found()
        if run.in_view and not run.found:
            run.found = True
            yield self._event("victim_found")

    def _wanted_images(self, header: Message, made: Iterable[Message] = ()) -> Iterator[Message]:
        """Make the images that cost time and are seldom listened to, without those that were made before."""
        there = {message.topic_name for message in made}
        if DEPTH.name not in there and self._wanted(DEPTH):
            yield depth_message(header, self._world.depth_m())
        mount = self._world.overhead_mount
        if OVERHEAD.name not in there and mount is not None and self._wanted(OVERHEAD):
            yield overhead_message(header, self._world.overhead(), mount)

    def _apply(self, run: _Running, applied: Applied) -> CommandApplied:
        """Make the record of what moves the robot; remembers it, to say so again only when it changes."""
        run.applied = applied
        sequence, run.said = run.said, run.said + 1
        latency_s = None if applied.source is None else run.latency_s.get(applied.source)
        return CommandApplied.after(
            self._header(run),
            sequence=sequence,
            atom=applied.atom,
            speed=applied.speed,
            source=applied.source,
            reason=applied.reason,
            answered_tick=applied.answered_tick,
            latency_ns=None if latency_s is None else round(latency_s * 1e9),
            emergency_stop=self.gate.emergency_stop,
            refused=sum(self.gate.refused.values()),
        )

    def _event(self, name: EventName, outcome: Outcome | None = None) -> Episode:
        run = self._running
        assert run is not None  # noqa: S101 - callers hold a running episode
        return Episode.after(
            self._header(run),
            event=name,
            purpose=run.request.purpose,
            driver=run.request.driver,
            world=self._world.name,
            seed=run.request.seed,
            goal=run.request.goal,
            outcome=outcome,
        )

    def _header(self, run: _Running) -> Message:
        return Message(robot=self._robot, episode=run.id, tick=run.tick, stamp_ns=run.stamp_ns)


def _what(applied: Applied) -> tuple[Atom, float, Source | None]:
    """Return what has to be told anew when it changes within a tick."""
    return applied.atom, applied.speed, applied.source
