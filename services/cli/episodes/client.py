"""A client that has episodes run and keeps what a report needs of them."""

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
from schemas.command import CommandApplied
from schemas.episode import Episode, Outcome, Said
from schemas.heartbeat import Heartbeat
from schemas.motion import TruePose
from schemas.rpc import ArmRequest, EndRequest, Nothing, ResetReply, ResetRequest, Status
from services.cli.stack import Access
from services.experiments.progress import bar_of
from services.kit.bus import RpcError
from services.kit.errors import JobError
from services.kit.jpeg import decode_jpeg
from services.kit.node import Node
from services.kit.settings import ServiceSettings

BEAT_S: Final = 0.5  # How often the robot hears that whoever began its episode is there.
SILENCE_S: Final = 60.0  # Seconds without any sign of the robot after which an episode is given up.
JUDGED_S: Final = 30.0  # Time for a person to look whether the robot is where it says that it is; it stands meanwhile.


@dataclass
class EpisodeRecord:
    """What was seen of one episode; what is told of single frames is kept by their tick."""

    request: ResetRequest
    world: str = ""  # Name of the world, or of a real robot's body.
    ticks: int = 0  # Frames that passed.
    outcome: Outcome = "aborted"
    right: bool | None = None  # Whether "not here" was so, where somebody knows.
    things: tuple[
        tuple[tuple[float, float], ...], ...
    ] = ()  # Outlines of what stood there anew, metres.
    poses: dict[int, tuple[float, float]] = field(
        default_factory=dict
    )  # True poses, (x, y) metres.
    said: Said | None = None  # What the robot said of the goal.
    decisions: dict[int, str] = field(default_factory=dict)  # Kind of every decision.
    unrecognized: set[int] = field(
        default_factory=set
    )  # Decisions that were taken without a recognized state.
    latencies_ms: dict[int, float] = field(
        default_factory=dict
    )  # From a frame to the acceptance of its command.
    frames: dict[int, NDArray[np.uint8]] = field(
        default_factory=dict
    )  # Some camera images of the way.


class EpisodeClient:
    """Runs one episode after another on a stack, by this name on the bus."""

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

    def watch_poses(
        self, handler: Callable[[TruePose], Message | None] = lambda _pose: None
    ) -> None:
        """Keep the true poses; ``handler`` sees each as well, and may answer."""

        def on_pose(pose: TruePose) -> Message | None:
            if record := self._of(pose):
                record.poses[pose.tick] = (pose.x_m, pose.y_m)
            return handler(pose)

        self.node.subscribe(topics.POSE, on_pose, depth=256)

    def watch_frames(self, every: int) -> None:
        """Keep each ``every``-th camera image."""

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
        """Run one episode to its end; JobError when the robot is in another world than asked for, or falls silent.

        `on_begin` is called with the robot's reply, before any message of the episode is handled, and may raise
        JobError. `done` ends the episode when it holds; the robot ends it as well, by what it says of the goal.
        `on_tick` is called with the tick, now and then, and `check` raises when the stack can no longer work.
        """
        self._record = record = EpisodeRecord(request)
        self._ended = False
        self._arm()
        # Rendering may be compiling its pipelines: the first reset takes seconds.
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
            self._end()  # Nobody will drive it.
            raise
        while not self.node.spin(
            until=lambda: self._ended or record.said is not None or done(), timeout_s=0.5
        ):
            on_tick(record.ticks)
            check()
            if time.monotonic() - self._alive_s > SILENCE_S:
                raise JobError(
                    f"no sign of robot {self.node.robot} for {SILENCE_S:.0f} s; see the stack's logs"
                )
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
        """Run one episode after another, with one bar over all of them; see `run`."""
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
        """Return the record of the episode that a message is of, if it is the one that runs."""
        return self._record if message.episode == self._episode else None

    def _await_judge(self) -> None:
        """Give the operator time to say that the goal is found, where nobody else can."""
        robot = self.node.bus.call("robot", "status", Nothing(), Status).detail
        if robot.get("judge") == "operator" and robot.get("operator"):
            said = f"it says that it has arrived; if so, say it within {JUDGED_S:.0f} s (f in smal teleop)"
            tqdm.write(said, file=sys.stderr)
            self.node.spin(until=lambda: self._ended, timeout_s=JUDGED_S)

    def _arm(self) -> None:
        """Arm once a robot that nobody has armed since its start; to what stops it otherwise, a person has to see."""
        if self._armed:
            return
        robot = self.node.bus.call("robot", "status", Nothing(), Status).detail
        if robot.get("stop_cause") == "not_armed" and not robot.get("attended"):
            request = ArmRequest(stop=int(robot["emergency_stop"] or 0), session=self.node.session)
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
            refusal = error  # It may have ended by itself; then its last message is on the way.
        if not self.node.spin(until=lambda: self._ended, timeout_s=10.0):
            raise refusal or JobError(f"episode {self._episode} did not end")

    def close(self) -> None:
        """Leave the bus."""
        self.node.close()

    def _on_event(self, event: Episode) -> None:
        record = self._of(event)
        if record and event.event == "ended":
            record.ticks = event.tick
            record.outcome = event.outcome or "aborted"
            record.right = event.right
            # What is decided about the last frame moves nothing any more, and may or may not have arrived by now.
            record.decisions = {
                tick: kind for tick, kind in record.decisions.items() if tick < event.tick
            }
            record.unrecognized = {tick for tick in record.unrecognized if tick < event.tick}
            self._ended = True

    def _on_applied(self, applied: CommandApplied) -> None:
        if record := self._of(applied):
            self._alive_s = time.monotonic()
            record.ticks = max(record.ticks, applied.tick)
            if applied.latency_ns is not None and applied.answered_tick is not None:
                record.latencies_ms.setdefault(applied.answered_tick, applied.latency_ns / 1e6)

    def _on_action(self, action: Action) -> None:
        if record := self._of(action):
            record.decisions[action.tick] = action.kind
            # The policy speaks also where somebody else drives.
            if record.request.driver == "policy":
                record.said = record.said or action.says
            # Not the kind says so: the robot also looks around where the state is known but has no way on.
            if action.state is None:
                record.unrecognized.add(action.tick)
