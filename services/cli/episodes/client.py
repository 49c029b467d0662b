"""A client that has episodes run and keeps what a report needs of them."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import count
from typing import Final

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from schemas import topics
from schemas.action import Action
from schemas.base import Message
from schemas.command import CommandApplied
from schemas.compressed_image import CompressedImage
from schemas.episode import Episode
from schemas.heartbeat import Heartbeat
from schemas.pose import Pose
from schemas.rpc import ArmRequest, EndRequest, Nothing, ResetReply, ResetRequest, Status
from services.kit.bus import RpcError
from services.kit.errors import JobError
from services.kit.jpeg import decode_jpeg
from services.kit.node import Node
from services.kit.settings import ServiceSettings
from services.robot.episode import RunOutcome

#: How often the robot hears that whoever began its episode is there.
BEAT_S: Final = 0.5
#: Seconds without any sign of the robot after which an episode is given up.
SILENCE_S: Final = 60.0
#: Time for a person to look whether the robot is where it says that it is; it stands meanwhile.
JUDGED_S: Final = 30.0


@dataclass
class EpisodeRecord:
    """What was seen of one episode.

    Attributes
    ----------
    request
        How it was asked for.
    world
        Where it was: name of the world, or of a real robot's body.
    ticks
        Frames that passed.
    outcome
        How it ended.
    poses
        True poses, (x, y) metres, by tick.
    arrived
        Whether the robot said that it was at the goal.
    decisions
        Kind of every decision, by tick.
    unrecognized
        Ticks of the decisions that were taken without a recognized state.
    latencies_ms
        From a frame's readiness to the acceptance of its command, by tick.
    frames
        Some camera images of the way, by tick.
    """

    request: ResetRequest
    world: str = ""
    ticks: int = 0
    outcome: RunOutcome = "aborted"
    poses: dict[int, tuple[float, float]] = field(default_factory=dict)
    arrived: bool = False
    decisions: dict[int, str] = field(default_factory=dict)
    unrecognized: set[int] = field(default_factory=set)
    latencies_ms: dict[int, float] = field(default_factory=dict)
    frames: dict[int, NDArray[np.uint8]] = field(default_factory=dict)

    @property
    def unknown(self) -> int:
        """Decisions that were taken without a recognized state."""
        return len(self.unrecognized)

    @property
    def decision_latencies_ms(self) -> list[float]:
        """Latencies of the frames at which a decision was taken."""
        return [ms for tick, ms in self.latencies_ms.items() if tick in self.decisions]


def check_world_of(reply: ResetReply, wanted: str | None) -> None:
    """Compare the world of the stack with the one that was asked for, if one was.

    Raises
    ------
    JobError
        When they differ: the results would be those of another world.
    """
    if wanted is not None and reply.world != wanted:
        raise JobError(f"the stack runs {reply.world}, not {wanted}; start it with --world {wanted}")


class EpisodeClient:
    """Runs one episode after another on a stack.

    Parameters
    ----------
    name
        Name of this client on the bus.
    settings
        Robot and router.
    """

    def __init__(self, name: str, settings: ServiceSettings) -> None:
        self.node = Node(name, settings)
        self._episode = ""
        self._record: EpisodeRecord | None = None
        self._ended = False
        self._alive_s = 0.0
        self._beats = count()
        self._armed = False
        # Replayed: a busy machine may lose its connection for a moment, and an end that is not heard is waited for.
        self.node.subscribe(topics.EPISODE, self._on_event, replay=True)
        self.node.subscribe(topics.APPLIED, self._on_applied, depth=256)
        self.node.subscribe(topics.ACTION, self._on_action, depth=256)
        self.node.every(BEAT_S, self._beat)

    def watch_poses(self, handler: Callable[[Pose], Message | None] = lambda _pose: None) -> None:
        """Keep the true poses; ``handler`` sees each as well, and may answer."""

        def on_pose(pose: Pose) -> Message | None:
            if self._record is not None and pose.episode == self._episode:
                self._record.poses[pose.tick] = (pose.x_m, pose.y_m)
            return handler(pose)

        self.node.subscribe(topics.POSE, on_pose, depth=256)

    def watch_frames(self, every: int) -> None:
        """Keep each ``every``-th camera image."""

        def on_image(image: CompressedImage) -> None:
            if self._record is not None and image.episode == self._episode and image.tick % every == 0:
                self._record.frames[image.tick] = decode_jpeg(image.data)

        self.node.subscribe(topics.JPEG, on_image, depth=4)

    def run(
        self,
        request: ResetRequest,
        on_begin: Callable[[ResetReply], None] = lambda _reply: None,
        done: Callable[[], bool] = lambda: False,
        on_tick: Callable[[int], None] = lambda _tick: None,
        check: Callable[[], None] = lambda: None,
    ) -> EpisodeRecord:
        """Run one episode to its end.

        Parameters
        ----------
        request
            Seed, purpose, driver, mode.
        on_begin
            Called with the simulator's reply, before any message of the episode is handled; may raise JobError.
        done
            Ends the episode when it holds; the robot ends it as well, by saying that it is at the goal.
        on_tick
            Called with the tick, now and then, for a progress bar.
        check
            Raises when the stack can no longer work.

        Raises
        ------
        JobError
            When the robot falls silent.
        """
        self._record = record = EpisodeRecord(request)
        self._ended = False
        self._arm()
        # Rendering may be compiling its pipelines: the first reset takes seconds.
        asked = request.model_copy(update={"session": self.node.session})
        reply = self.node.bus.call("robot", "reset", asked, ResetReply, timeout_s=60.0)
        self._episode, record.world = reply.episode, reply.world
        self._alive_s = time.monotonic()
        try:
            on_begin(reply)
        except JobError:
            # Nobody will drive it.
            self._end(reply.episode)
            raise
        while not self.node.spin(until=lambda: self._ended or record.arrived or done(), timeout_s=0.5):
            on_tick(record.ticks)
            check()
            if time.monotonic() - self._alive_s > SILENCE_S:
                raise JobError(f"no sign of robot {self.node.robot} for {SILENCE_S:.0f} s; see the stack's logs")
        if record.arrived and not self._ended:
            self._await_judge()
        if not self._ended:
            self._end(reply.episode)
        if record.arrived and record.outcome == "aborted":
            record.outcome = "false_goal"
        on_tick(record.ticks)
        return record

    def _await_judge(self) -> None:
        """Give the operator time to say that the goal is found, where nobody else can."""
        detail = self.node.bus.call("robot", "status", Nothing(), Status).detail
        if detail.get("judge") == "operator" and detail.get("operator"):
            tqdm.write(
                f"it says that it has arrived; if so, say it within {JUDGED_S:.0f} s (f in smal teleop)",
                file=sys.stderr,
            )
            self.node.spin(until=lambda: self._ended, timeout_s=JUDGED_S)

    def _arm(self) -> None:
        """Arm a robot that nobody has armed since it was started, once: whoever begins a run wants it to move.

        One that stands for another reason, or was started again meanwhile, is armed by a person; and so is one that
        moves only while a person is there.
        """
        if self._armed:
            return
        detail = self.node.bus.call("robot", "status", Nothing(), Status).detail
        if detail.get("stop_cause") == "not_armed" and not detail.get("attended"):
            request = ArmRequest(stop=int(detail["emergency_stop"] or 0), session=self.node.session)
            self.node.bus.call("robot", "arm", request, Nothing)
        self._armed = True

    def _beat(self) -> None:
        if self._record is not None and self._episode and not self._ended:
            header = Message(robot=self.node.robot, episode=self._episode, tick=self._record.ticks, stamp_ns=0)
            own = {"session": self.node.session, "name": self.node.name, "sequence": next(self._beats)}
            self.node.publish(Heartbeat.after(header, **own))

    def _end(self, episode: str) -> None:
        refusal: RpcError | None = None
        try:
            self.node.bus.call("robot", "end", EndRequest(episode=episode, session=self.node.session), Nothing)
        except RpcError as error:
            # It may have ended by itself in the meantime; then its last message is on the way.
            refusal = error
        if not self.node.spin(until=lambda: self._ended, timeout_s=10.0):
            raise refusal or JobError(f"episode {episode} did not end")

    def close(self) -> None:
        """Leave the bus."""
        self.node.close()

    def _on_event(self, event: Episode) -> None:
        if self._record is not None and event.episode == self._episode and event.event == "ended":
            record = self._record
            record.ticks, record.outcome = event.tick, event.outcome or "aborted"
            # What is decided about the last frame moves nothing any more, and may or may not have arrived by now.
            record.decisions = {tick: kind for tick, kind in record.decisions.items() if tick < event.tick}
            record.unrecognized = {tick for tick in record.unrecognized if tick < event.tick}
            self._ended = True

    def _on_applied(self, applied: CommandApplied) -> None:
        if self._record is None or applied.episode != self._episode:
            return
        self._alive_s = time.monotonic()
        self._record.ticks = max(self._record.ticks, applied.tick)
        if applied.latency_ns is not None and applied.answered_tick is not None:
            self._record.latencies_ms.setdefault(applied.answered_tick, applied.latency_ns / 1e6)

    def _on_action(self, action: Action) -> None:
        if self._record is not None and action.episode == self._episode:
            self._record.decisions[action.tick] = action.kind
            # The policy speaks also where somebody else drives.
            self._record.arrived |= action.arrived and self._record.request.driver == "policy"
            # Not the kind says so: the robot also looks around where the state is known but has no way on.
            if action.state is None:
                self._record.unrecognized.add(action.tick)
