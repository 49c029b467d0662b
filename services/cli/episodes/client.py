"""Client that runs episodes and collects the data for a report."""

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import count
from typing import Final

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from schemas import topics
from schemas.action import Action
from schemas.base import Message
from schemas.camera import CompressedImage
from schemas.command import CommandApplied, StopCause
from schemas.episode import Episode, Outcome, Said
from schemas.heartbeat import Heartbeat
from schemas.motion import TruePose
from schemas.rpc import ArmRequest, EndRequest, Nothing, ResetReply, ResetRequest, Status
from services.cli.stack import Access
from services.experiments.progress import bar_of
from services.kit.bus import RpcError
from services.kit.errors import JobError
from services.kit.jpeg import decode_jpeg
from services.kit.node import Detail, Node
from services.kit.settings import ServiceSettings

BEAT_S: Final = 0.5  # Period of the heartbeat to the robot, seconds.
SILENCE_S: Final = 60.0  # Timeout without a sign of the robot, seconds.
JUDGED_S: Final = 30.0  # Time for the operator to confirm the goal while the robot stands, seconds.


@dataclass
class EpisodeRecord:
    """The data of one episode, by tick."""

    request: ResetRequest
    world: str = ""  # Name of the world, or of the body of a real robot.
    ticks: int = 0
    stamps_ns: dict[int, int] = field(default_factory=dict)  # Capture times of the frames.
    outcome: Outcome = "aborted"
    right: bool | None = None  # Whether a "not here" was correct, if known.
    kidnapped: int = 0  # How often the robot was kidnapped, by request or by a person.
    things: tuple[
        tuple[tuple[float, float], ...], ...
    ] = ()  # Outlines of the added obstacles, metres.
    poses: dict[int, tuple[float, float]] = field(
        default_factory=dict
    )  # True positions (x, y), metres.
    said: Said | None = None  # Announcement of the robot about the goal.
    decisions: dict[int, str] = field(default_factory=dict)
    unrecognized: set[int] = field(default_factory=set)  # Decisions without a recognized state.
    latencies_ms: dict[int, float] = field(
        default_factory=dict
    )  # Latency from a frame to the acceptance of its command.
    frames: dict[int, NDArray[np.uint8]] = field(
        default_factory=dict
    )  # A sample of the camera images.

    def seconds(self, tick: int) -> float:
        """Return the time of a frame since the first, by the robot's clock; 0 for an unknown one."""
        first_ns = min(self.stamps_ns.values(), default=0)
        return (self.stamps_ns.get(tick, first_ns) - first_ns) / 1e9


class EpisodeClient:
    """Runs episodes one after another on a stack."""

    def __init__(self, name: str, settings: ServiceSettings) -> None:
        self.node = Node(name, settings)
        self._episode = ""
        self._record: EpisodeRecord | None = None
        self._ended = False
        self._stop: StopCause | None = None  # Why the robot stands until it is armed.
        self._reported_stop: StopCause | None = None
        self._alive_s = 0.0
        self._beats = count()
        self._armed = False
        # Replayed: a busy machine can lose its connection for a moment and must not miss the end.
        self.node.subscribe(topics.EPISODE, self._on_event, replay=True)
        self.node.subscribe(topics.APPLIED, self._on_applied, depth=256)
        self.node.subscribe(topics.ACTION, self._on_action, depth=256)
        self.node.every(BEAT_S, self._beat)

    def watch_poses(
        self, handler: Callable[[TruePose], Message | None] = lambda _pose: None
    ) -> None:
        """Keep the true poses; the optional ``handler`` receives each pose and can answer."""

        def on_pose(pose: TruePose) -> Message | None:
            if record := self._of(pose):
                record.poses[pose.tick] = (pose.x_m, pose.y_m)
            return handler(pose)

        self.node.subscribe(topics.POSE, on_pose, depth=256)

    def watch_frames(self, every: int) -> None:
        """Keep every ``every``-th camera image."""

        def on_image(image: CompressedImage) -> None:
            record = self._of(image)
            if record and image.tick % every == 0:
                record.frames[image.tick] = decode_jpeg(image.data)

        self.node.subscribe(topics.JPEG, on_image, depth=4)

    def run(
        self,
        request: ResetRequest,
        on_begin: Callable[[ResetReply], None] = lambda _reply: None,
        done: Callable[[], bool] = lambda: False,
        on_tick: Callable[[int], None] = lambda _tick: None,
        check: Callable[[], None] = lambda: None,
        world: str | None = None,
    ) -> EpisodeRecord:
        """Run one episode to its end.

        Parameters
        ----------
        request : ResetRequest
            The episode to start.
        on_begin : callable
            Called with the robot's reply before any message of the episode; can raise JobError.
        done : callable
            Ends the episode when it returns true. The robot's announcement about the goal ends it
            as well.
        on_tick : callable
            Called with the tick, for progress.
        check : callable
            Raises an error when the stack cannot continue.
        world : str, optional
            Expected name of the world.

        Raises
        ------
        JobError
            If the robot is in another world, sends nothing for `SILENCE_S`, or ends the episode
            because of an error; if its body fails and no operator can arm it.
        """
        self._record = record = EpisodeRecord(request)
        self._ended = False
        self._stop = None
        self._reported_stop = None
        self._arm()
        # The first reset takes seconds when the renderer compiles its pipelines.
        asked = request.model_copy(update={"session": self.node.session})
        reply = self.node.bus.call("robot", "reset", asked, ResetReply, timeout_s=60.0)
        self._episode = reply.episode
        record.world = reply.world
        record.things = reply.things
        self._alive_s = time.monotonic()
        try:
            if world not in (None, reply.world):
                raise JobError(
                    f"the stack runs {reply.world}, not {world}; start it with --world {world}"
                )
            on_begin(reply)
        except JobError:
            self._end()
            raise
        while not self.node.spin(
            until=lambda: self._ended or record.said is not None or done(), timeout_s=0.5
        ):
            on_tick(record.ticks)
            check()
            self._report_stop()
            if time.monotonic() - self._alive_s > SILENCE_S:
                raise JobError(
                    f"robot {self.node.robot}: no message for {SILENCE_S:.0f} s; see the "
                    "stack's logs"
                )
        if record.outcome == "aborted" and self._ended:
            self._raise_fault()
        if record.said == "found" and not self._ended:
            self._await_judge()
        if not self._ended:
            self._end(record.said)
        if record.said == "found" and record.outcome == "aborted":
            record.outcome = "false_goal"
        on_tick(record.ticks)
        return record

    def run_all(
        self,
        requests: Sequence[ResetRequest],
        access: Access,
        what: str,
        *,
        world: str | None,
        on_begin: Callable[[ResetReply], None] = lambda _reply: None,
        done: Callable[[], bool] = lambda: False,
    ) -> Iterator[EpisodeRecord]:
        """Run episodes with a common progress bar; see `run`."""
        outcomes: list[Outcome] = []
        with bar_of(requests, desc=what, unit="episode") as bar:

            def show(tick: int) -> None:
                bar.set_postfix_str(
                    f"{outcomes.count('found')} of {len(outcomes)} found, frame {tick}"
                )

            for request in bar:
                record = self.run(request, on_begin, done, show, access.check, world)
                outcomes.append(record.outcome)
                show(record.ticks)
                yield record

    def _of(self, message: Message) -> EpisodeRecord | None:
        """Return the current record if a message belongs to its episode, and keep its time."""
        if self._record is None or message.episode != self._episode:
            return None
        self._record.stamps_ns[message.tick] = message.stamp_ns
        return self._record

    def _robot(self) -> Detail:
        """Return the robot's status."""
        return self.node.bus.call("robot", "status", Nothing(), Status).detail

    def _raise_fault(self) -> None:
        """Raise JobError with the error that ended the episode, if any."""
        robot = self._robot()
        if robot.get("fault"):
            raise JobError(f"episode {self._episode} ended by an error: {robot['fault']}")

    def _report_stop(self) -> None:
        """Print a new reason why the robot stands; JobError if its body has failed and no operator can arm it."""
        cause = self._stop
        changed = cause != self._reported_stop
        self._reported_stop = cause
        if cause is None or not changed:
            return
        robot = self._robot()
        why = f"the robot stands: {cause.replace('_', ' ')}"
        if cause == "fault":
            why = f"the robot's body has failed: {robot.get('fault')}"
            if not robot.get("operator"):
                self._end()
                raise JobError(why)
        tqdm.write(f"{why}; arm it on the page or in smal teleop (r)", file=sys.stderr)

    def _await_judge(self) -> None:
        """Give the operator time to confirm the goal if only a person can judge it."""
        robot = self._robot()
        if robot.get("judge") == "operator" and robot.get("operator"):
            said = (
                f"the robot announces its arrival; confirm it within {JUDGED_S:.0f} s "
                "(f in smal teleop)"
            )
            tqdm.write(said, file=sys.stderr)
            self.node.spin(until=lambda: self._ended, timeout_s=JUDGED_S)

    def _arm(self) -> None:
        """Arm a robot that has not been armed since its start; later stops need a person."""
        if self._armed:
            return
        robot = self._robot()
        if robot.get("stop_cause") == "not_armed" and not robot.get("attended"):
            request = ArmRequest(stop=int(robot["latched_stop"] or 0), session=self.node.session)
            self.node.bus.call("robot", "arm", request, Nothing)
        self._armed = True

    def _beat(self) -> None:
        if self._record is not None and self._episode and not self._ended:
            header = Message(
                robot=self.node.robot, episode=self._episode, tick=self._record.ticks, stamp_ns=0
            )
            own = {
                "session": self.node.session,
                "name": self.node.name,
                "sequence": next(self._beats),
            }
            self.node.publish(Heartbeat.after(header, **own))

    def _end(self, said: Said | None = None) -> None:
        refusal: RpcError | None = None
        try:
            request = EndRequest(episode=self._episode, said=said, session=self.node.session)
            self.node.bus.call("robot", "end", request, Nothing)
        except RpcError as error:
            refusal = error  # If the episode ended by itself, its last message is on the way.
        if not self.node.spin(until=lambda: self._ended, timeout_s=10.0):
            raise refusal or JobError(f"episode {self._episode} did not end")

    def close(self) -> None:
        """Leave the bus."""
        self.node.close()

    def _on_event(self, event: Episode) -> None:
        record = self._of(event)
        if record and event.event == "kidnapped":
            record.kidnapped += 1
        if record and event.event == "ended":
            record.ticks = event.tick
            record.outcome = event.outcome or "aborted"
            record.right = event.right
            # A decision about the last frame has no effect and arrives or not by chance.
            record.decisions = {
                tick: kind for tick, kind in record.decisions.items() if tick < event.tick
            }
            record.unrecognized = {tick for tick in record.unrecognized if tick < event.tick}
            self._ended = True

    def _on_applied(self, applied: CommandApplied) -> None:
        if record := self._of(applied):
            self._alive_s = time.monotonic()
            self._stop = applied.stop_cause
            record.ticks = max(record.ticks, applied.tick)
            if applied.latency_ns is not None and applied.answered_tick is not None:
                record.latencies_ms.setdefault(applied.answered_tick, applied.latency_ns / 1e6)

    def _on_action(self, action: Action) -> None:
        if record := self._of(action):
            record.decisions[action.tick] = action.kind
            # The policy also announces when another driver drives.
            if record.request.driver == "policy":
                record.said = record.said or action.says
            # The kind does not show it: the robot also searches in a known state without an action.
            if action.state is None:
                record.unrecognized.add(action.tick)
