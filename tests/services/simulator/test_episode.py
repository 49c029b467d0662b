"""Episodes of a robot in a world without pixels: lockstep, real time, and every way to end."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterator
from typing import cast, get_args

import numpy as np
import pytest
from numpy.typing import NDArray

from schemas.base import Atom, Message
from schemas.camera_info import CameraInfo
from schemas.command import Command, CommandApplied
from schemas.compressed_image import CompressedImage
from schemas.depth_image import DepthImage
from schemas.episode import Episode, Purpose
from schemas.image import Image
from schemas.imu import Imu
from schemas.odometry import Odometry
from schemas.overhead_image import OverheadImage
from schemas.pose import Pose
from schemas.rpc import ResetRequest, ResumeRequest
from schemas.topics import DEPTH, OVERHEAD, Topic
from services.kit.node import Node, ServiceError
from services.robot.gate import MAX_AGE_S, Refusal
from services.simulator.base import STEP_S
from services.simulator.drive import TICK_S
from services.simulator.episode import GIVE_UP_S, RESEND_S, EpisodeRunner
from services.simulator.sensors import ImuReading, OdometryReading
from services.simulator.sensors.messages import FARTHEST_M, depth_message
from services.simulator.service import LATCHED, TAKEN_OVER, SimulatorService
from services.simulator.world.place import OverheadMount
from services.simulator.world.place import Pose as PlanarPose


class Line:
    """A world of one dimension: a victim at ``victim`` and a wall at ``wall`` on a line."""

    name = "line"
    focal_px = 20.0
    speed_m_s, found_m = 2.0, 5.0

    def __init__(self, victim: float = 1e9, wall: float = 1e9, sight: float = 1e9) -> None:
        self.x, self.victim, self.wall, self.sight = 0.0, victim, wall, sight
        self.moves: list[tuple[Atom, float, float]] = []

    def reset(self, seed: int, purpose: Purpose, *, anywhere: bool = False) -> PlanarPose:
        self.x = 30.0 if anywhere else 0.0
        self.moves.clear()
        return self.pose

    def carry_away(self) -> PlanarPose:
        self.x = 70.0
        return self.pose

    def advance(self, atom: Atom, speed: float, duration_s: float) -> PlanarPose:
        self.moves.append((atom, speed, duration_s))
        self.x += {"forward": 2.0, "backward": -2.0}.get(atom, 0.0) * speed * duration_s
        return self.pose

    def render(self) -> NDArray[np.uint8]:
        return np.full((24, 32, 3), int(10 * self.x) % 256, dtype=np.uint8)

    def depth_m(self) -> NDArray[np.float32]:
        return np.full((480, 640), self.x + 1.0, dtype=np.float32)

    overhead_mount: OverheadMount | None = OverheadMount(1.0, 2.0, 4.0, 0.5, 40, 30, 20.0)

    def overhead(self) -> NDArray[np.uint8]:
        return np.full((30, 40, 3), int(10 * self.x) % 256, dtype=np.uint8)

    def odometry(self) -> OdometryReading:
        return OdometryReading(self.x, 0.0, 0.0, 2.0, 0.0)

    def imu(self) -> tuple[ImuReading, ...]:
        return (ImuReading(0.02, (0.0, 0.0, 0.1), (0.0, 0.0, 9.81)),)

    def victim_found(self) -> bool:
        return self.victim <= self.x <= self.victim + self.sight

    def route(self) -> NDArray[np.float64]:
        return np.array([[0.0, 0.0], [self.victim, 0.0]])

    @property
    def pose(self) -> PlanarPose:
        return PlanarPose(self.x, 0.0, 0.0)

    @property
    def collided(self) -> bool:
        return self.x >= self.wall


class Clock:
    """A clock that the test moves."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def answer(
    runner: EpisodeRunner, atom: Atom = "forward", tick: int | None = None, sequence: int = 0, speed: float = 1.0
) -> list[Message]:
    run = runner.running
    assert run is not None
    tick = run.tick if tick is None else tick
    header = Message(robot="r", episode=run.id, tick=tick, stamp_ns=0)
    return list(runner.offer(Command.after(header, source="policy", sequence=sequence, atom=atom, speed=speed)))


def stop_for_emergency(runner: EpisodeRunner) -> list[Message]:
    runner.gate.stop()
    return list(runner.poll())


def begin(world: Line, **request: object) -> tuple[EpisodeRunner, Clock, list[Message]]:
    clock = Clock()
    runner = EpisodeRunner(world, "r", "s", clock, lambda: 5)
    _, messages = runner.reset(ResetRequest.model_validate({"seed": 1} | request))
    return runner, clock, messages


def events(messages: list[Message]) -> list[tuple[str, str | None]]:
    return [(m.event, m.outcome) for m in messages if isinstance(m, Episode)]


def test_an_episode_begins_anywhere_and_goes_on_elsewhere_where_that_is_asked_for() -> None:
    where: dict[str, list[float]] = {}
    for name, request in (("plain", {}), ("anywhere", {"start": "anywhere"}), ("kidnapped", {"kidnap_tick": 3})):
        runner, _, messages = begin(Line(), **request)
        for _ in range(5):
            messages += answer(runner)
        where[name] = [pose.x_m for pose in messages if isinstance(pose, Pose)]
    assert where["plain"] == pytest.approx([0.0, 0.2, 0.4, 0.6, 0.8, 1.0])
    assert where["anywhere"] == pytest.approx([30.0, 30.2, 30.4, 30.6, 30.8, 31.0])
    assert where["kidnapped"] == pytest.approx([0.0, 0.2, 0.4, 70.0, 70.2, 70.4])


def test_lockstep_waits_for_each_answer_and_moves_exactly_one_tick() -> None:
    world = Line()
    runner, clock, messages = begin(world)
    assert [type(m) for m in messages] == [Episode, CameraInfo, Odometry, Imu, Pose, Image, CompressedImage]
    (info,) = (m for m in messages if isinstance(m, CameraInfo))
    assert (info.width, info.height, info.focal_px, info.centre_x_px, info.centre_y_px) == (32, 24, 20.0, 16.0, 12.0)
    clock.now_s += RESEND_S / 2
    assert not list(runner.poll())
    messages = answer(runner)
    assert [type(m) for m in messages] == [CommandApplied, Odometry, Imu, Pose, Image, CompressedImage]
    assert world.moves == [("forward", 1.0, TICK_S)]
    assert isinstance(messages[0], CommandApplied)
    assert messages[0].latency_ns == pytest.approx(1e9 * RESEND_S / 2)
    assert [m.tick for m in messages] == [0, 1, 1, 1, 1, 1]
    assert messages[1].stamp_ns == 5 + 100_000_000


def test_lockstep_ignores_answers_to_other_frames() -> None:
    world = Line()
    runner, _, _ = begin(world)
    answer(runner)
    for tick in (0, 2):
        assert answer(runner, tick=tick) == []
    assert len(world.moves) == 1


def test_lockstep_sends_a_lost_frame_again_and_then_gives_up() -> None:
    runner, clock, first = begin(Line())
    clock.now_s += RESEND_S + 0.1
    assert list(runner.poll()) == first[4:6], "not what is recorded: its sender keeps it for whoever missed it"
    clock.now_s += 0.1
    assert not list(runner.poll())
    clock.now_s += GIVE_UP_S
    assert events(list(runner.poll())) == [("ended", "aborted")]


class Watched(Line):
    """A world that counts its costly pictures."""

    def __init__(self) -> None:
        super().__init__()
        self.made: Counter[Topic] = Counter()

    def depth_m(self) -> NDArray[np.float32]:
        self.made[DEPTH] += 1
        return super().depth_m()

    def overhead(self) -> NDArray[np.uint8]:
        self.made[OVERHEAD] += 1
        return super().overhead()


@pytest.mark.parametrize("listened", [set(), {DEPTH}, {OVERHEAD}, {DEPTH, OVERHEAD}], ids=len)
def test_costly_pictures_are_made_only_while_somebody_listens(listened: set[Topic]) -> None:
    world, clock, wanted = Watched(), Clock(), set[Topic]()
    runner = EpisodeRunner(world, "r", "s", clock, lambda: 5, wanted=wanted.__contains__)
    runner.reset(ResetRequest(seed=1))
    assert not [m for m in answer(runner) if isinstance(m, DepthImage | OverheadImage)]
    wanted |= listened
    messages = answer(runner)
    assert {m.topic_name for m in messages if isinstance(m, DepthImage | OverheadImage)} == {t.name for t in listened}
    assert all(m.tick == 2 for m in messages if isinstance(m, DepthImage | OverheadImage))
    assert [type(m) for m in messages][-2:] == [Image, CompressedImage], "what is answered comes last"
    clock.now_s += RESEND_S + 0.1
    resent = list(runner.poll())
    assert [m for m in messages if isinstance(m, Pose | DepthImage | OverheadImage | Image)] == resent
    wanted.clear()
    answer(runner)
    assert world.made == Counter(listened), "each was made once: a frame that is sent again is not made again"


def test_a_place_without_a_camera_above_sends_none() -> None:
    world = Watched()
    world.overhead_mount = None
    runner = EpisodeRunner(world, "r", "s", Clock(), lambda: 5, wanted=lambda _: True)
    _, messages = runner.reset(ResetRequest(seed=1))
    assert not [m for m in messages if isinstance(m, OverheadImage)]
    assert world.made == {DEPTH: 1}


def test_the_overhead_image_tells_how_its_camera_hangs() -> None:
    runner = EpisodeRunner(Line(), "r", "s", Clock(), lambda: 5, wanted=lambda _: True)
    _, messages = runner.reset(ResetRequest(seed=1))
    (image,) = (m for m in messages if isinstance(m, OverheadImage))
    assert (image.width, image.height) == (40, 30)
    told = image.calibration
    assert (told.focal_px, told.centre_x_px, told.centre_y_px) == (20.0, 20.0, 15.0)
    assert (told.x_m, told.y_m, told.height_m, told.up_rad) == (1.0, 2.0, 4.0, 0.5)


@pytest.mark.parametrize(
    ("size", "every"), [((480, 640), 2), ((768, 1024), 4), ((48, 64), 1), ((241, 321), 2), ((3072, 4096), 13)], ids=str
)
def test_depth_is_told_in_millimetres_of_some_pixels(size: tuple[int, int], every: int) -> None:
    rows, columns = np.mgrid[: size[0], : size[1]].astype(np.float32)
    header = Message(robot="r", episode="e", tick=0, stamp_ns=0)
    message = depth_message(header, (rows + columns / 10000).astype(np.float32))
    told = message.to_numpy()
    assert told.shape[0] <= 240
    assert told.shape[1] <= 320
    for row, column in [(0, 0), (7, 3), (told.shape[0] - 1, told.shape[1] - 1)]:
        from_row, from_column = row * every + every // 2, column * every + every // 2
        far = from_row + from_column / 10000 > FARTHEST_M
        assert told[row, column] == (0 if far else pytest.approx(1000 * (from_row + from_column / 10000), abs=0.51))


def test_nothing_in_range_is_zero() -> None:
    header = Message(robot="r", episode="e", tick=0, stamp_ns=0)
    depth_m = np.array([[np.inf, 65.1, 65.0, 0.0004, 1.2345]], dtype=np.float32)
    assert depth_message(header, depth_m).to_numpy().tolist() == [[0, 0, 65000, 0, 1234]]


def test_run_ends_when_the_victim_is_found() -> None:
    runner, _, _ = begin(Line(victim=0.3))
    assert events(answer(runner)) == []
    assert events(answer(runner)) == [("victim_found", None), ("ended", "found")]
    assert runner.running is None


def test_demonstration_goes_on_after_the_victim_is_found_until_it_is_ended() -> None:
    runner, _, _ = begin(Line(victim=0.3), purpose="drive")
    answer(runner)
    assert events(answer(runner)) == [("victim_found", None)]
    assert events(answer(runner)) == []
    assert events(runner.end(None)) == [("ended", "found")]


def test_demonstration_that_passes_the_victim_and_goes_on_has_not_found_it() -> None:
    runner, _, _ = begin(Line(victim=0.3, sight=0.2), purpose="drive")
    answer(runner)
    assert events(answer(runner)) == [("victim_found", None)]
    assert events(answer(runner)) == []
    assert events(runner.end(None)) == [("ended", "aborted")]


def test_demonstration_that_comes_back_to_the_victim_has_found_it_there() -> None:
    runner, _, _ = begin(Line(victim=0.3, sight=0.2), purpose="drive")
    for atom in ("forward", "forward", "forward", "backward"):
        messages = answer(runner, atom)
        assert events(messages) in ([], [("victim_found", None)])
    (ended,) = runner.end(None)
    assert isinstance(ended, Episode)
    assert (ended.outcome, ended.tick) == ("found", 4)


@pytest.mark.parametrize(
    ("sight", "expected"), [(1.0, [("ended", "found")]), (0.2, [("timed_out", None), ("ended", "timeout")])]
)
@pytest.mark.parametrize("purpose", ["drive", "recovery"])
def test_the_last_frame_allowed_is_a_goal_if_it_shows_the_victim(
    sight: float, expected: list[tuple[str, str | None]], purpose: str
) -> None:
    runner, _, _ = begin(Line(victim=0.3, sight=sight), purpose=purpose, max_ticks=3)
    answer(runner)
    answer(runner)
    assert events(answer(runner)) == expected


@pytest.mark.parametrize(
    ("world", "request_", "expected"),
    [
        (Line(wall=0.1), {}, [("collision", None), ("ended", "collision")]),
        (Line(), {"max_ticks": 1}, [("timed_out", None), ("ended", "timeout")]),
    ],
)
def test_other_ends(world: Line, request_: dict[str, object], expected: list[tuple[str, str | None]]) -> None:
    runner, _, _ = begin(world, **request_)
    assert events(answer(runner)) == expected


def test_reset_ends_the_running_episode_first() -> None:
    runner, _, _ = begin(Line())
    _, messages = runner.reset(ResetRequest(seed=2))
    assert events(messages) == [("ended", "aborted"), ("started", None)]
    assert messages[0].episode != messages[1].episode


def advance(runner: EpisodeRunner, clock: Clock, duration_s: float) -> list[Message]:
    messages: list[Message] = []
    end_s = clock.now_s + duration_s
    while clock.now_s < end_s:
        clock.now_s += STEP_S
        messages += runner.poll()
    return messages


def test_realtime_makes_ten_frames_a_second_whether_commanded_or_not() -> None:
    runner, clock, _ = begin(Line(), mode="realtime")
    images = [m for m in advance(runner, clock, 2.0) if isinstance(m, Image)]
    assert len(images) in {19, 20}


def test_realtime_silence_stops_the_robot_within_half_a_second() -> None:
    world = Line()
    runner, clock, _ = begin(world, mode="realtime")
    answer(runner)
    messages = advance(runner, clock, 1.5)
    moving = [duration for atom, _, duration in world.moves if atom == "forward"]
    assert MAX_AGE_S - 2 * STEP_S <= sum(moving) <= MAX_AGE_S + 1e-9
    assert world.moves[-1][0] == "stop"
    applied = [m for m in messages if isinstance(m, CommandApplied)]
    assert (applied[0].reason, applied[-1].reason) == ("command", "silence")


def test_realtime_stamps_are_when_frames_were_captured_whatever_happens_to_the_wall_clock() -> None:
    clock = Clock()
    wall_ns = iter([7_000_000_000])
    runner = EpisodeRunner(Line(), "r", "s", clock, lambda: next(wall_ns))
    runner.reset(ResetRequest(seed=1, mode="realtime"))
    captured_s = {}
    for _ in range(3):
        clock.now_s += 0.35  # slower than real time: the stamps are true all the same
        captured_s |= {(m.tick, clock.now_s): m.stamp_ns for m in runner.poll() if isinstance(m, Image)}
    assert len(captured_s) >= 2
    assert all(stamp_ns == 7_000_000_000 + round(1e9 * (now_s - 100.0)) for (_, now_s), stamp_ns in captured_s.items())


def test_realtime_slow_rendering_slows_the_world_and_skips_no_frame() -> None:
    runner, clock, _ = begin(Line(), mode="realtime")
    ticks: list[int] = []
    for _ in range(20):
        clock.now_s += 0.35
        ticks += [m.tick for m in runner.poll() if isinstance(m, Image)]
    assert ticks == list(range(1, len(ticks) + 1))
    assert len(ticks) >= 15
    assert runner.slow_ticks > 0


def test_messages_order_within_a_tick_is_told() -> None:
    runner, clock, _ = begin(Line(), mode="realtime")
    answer(runner)
    messages = advance(runner, clock, 0.13)
    answer(runner, "left")
    messages += advance(runner, clock, 0.03)
    answer(runner, "right", sequence=1)
    messages += advance(runner, clock, 1.0)
    applied = [m for m in messages if isinstance(m, CommandApplied)]
    said = Counter(m.tick for m in applied)
    assert [(m.tick, m.sequence) for m in applied] == [(tick, k) for tick in sorted(said) for k in range(said[tick])]
    assert (said[0], said[1]) == (1, 3)


def test_lockstep_says_once_a_tick_what_moves_the_robot() -> None:
    runner, _, _ = begin(Line())
    said = [m for _ in range(3) for m in answer(runner) if isinstance(m, CommandApplied)]
    assert [(m.tick, m.sequence, m.answered_tick) for m in said] == [(0, 0, 0), (1, 0, 1), (2, 0, 2)]


def test_a_change_of_speed_alone_is_told() -> None:
    runner, clock, _ = begin(Line(), mode="realtime")
    answer(runner)
    advance(runner, clock, 0.03)
    answer(runner, sequence=1, speed=0.5)
    applied = [m for m in advance(runner, clock, 0.03) if isinstance(m, CommandApplied)]
    assert [(m.atom, m.speed) for m in applied] == [("forward", 0.5)]


def test_latency_belongs_to_the_frame_that_was_answered() -> None:
    """The heartbeat of a frame goes out before that frame can have been answered."""
    runner, clock, _ = begin(Line(), mode="realtime")
    latencies: dict[int, set[int | None]] = {}
    applied: list[CommandApplied] = []
    for tick in range(5):
        clock.now_s += 0.01 * (tick + 1)
        answer(runner, tick=tick)
        while runner.running is not None and runner.running.tick == tick:
            applied += [m for m in advance(runner, clock, STEP_S) if isinstance(m, CommandApplied)]
    assert [(m.tick, m.answered_tick) for m in applied] == [(0, 0), *((tick + 1, tick) for tick in range(5))]
    for message in applied:
        assert message.answered_tick is not None
        latencies.setdefault(message.answered_tick, set()).add(message.latency_ns)
    for tick, seen in latencies.items():
        assert list(seen) == [pytest.approx(1e7 * (tick + 1))]


class SlowLine(Line):
    """A world whose pictures take their time, and which notes when the robot was moved."""

    def __init__(self) -> None:
        super().__init__()
        self.clock = Clock()
        self.moved_s = 0.0

    def advance(self, atom: Atom, speed: float, duration_s: float) -> PlanarPose:
        if atom != "stop":
            self.moved_s = self.clock.now_s
        return super().advance(atom, speed, duration_s)

    def render(self) -> NDArray[np.uint8]:
        self.clock.now_s += 0.1
        return super().render()


def test_realtime_slow_rendering_does_not_prolong_a_command() -> None:
    for answered in range(1, 30):
        world = SlowLine()
        runner = EpisodeRunner(world, "r", "s", world.clock, lambda: 5)
        runner.reset(ResetRequest(seed=1, mode="realtime"))
        while runner.running is not None and runner.running.tick < answered:
            answer(runner, tick=runner.running.tick)
            advance(runner, world.clock, STEP_S)
        assert runner.running is not None
        captured_s, tick = world.clock.now_s - 0.1, runner.running.tick
        answer(runner, tick=tick)
        advance(runner, world.clock, 2.0)
        assert world.moved_s > captured_s
        assert world.moved_s - captured_s <= MAX_AGE_S + 1e-9


class FakeNode:
    """A node that only keeps what a service gives it."""

    def __init__(self) -> None:
        self.published: list[Message] = []
        self.decisions: list[tuple[str, float]] = []

    def subscribe(self, *_: object) -> None: ...

    def at_once(self, *_: object) -> None: ...

    def serve(self, *_: object) -> None: ...

    def every(self, *_: object) -> None: ...

    @property
    def log(self) -> FakeNode:
        return self

    @property
    def metrics(self) -> FakeNode:
        return self

    def decision(self, source: str, seconds: float) -> None:
        self.decisions.append((source, seconds))

    def info(self, *_: object) -> None: ...

    def publish(self, messages: Iterator[Message]) -> None:
        self.published += messages


def serve(world: Line) -> tuple[SimulatorService, EpisodeRunner, FakeNode]:
    runner, node = EpisodeRunner(world, "r", "s", Clock(), lambda: 5), FakeNode()
    return SimulatorService(runner, cast("Node", node)), runner, node


def running(runner: EpisodeRunner) -> None:
    runner.reset(ResetRequest(seed=1))


def ended(runner: EpisodeRunner) -> None:
    runner.reset(ResetRequest(seed=1))
    runner.end(None)


def never_run(_: EpisodeRunner) -> None:
    """Nothing has happened yet."""


@pytest.mark.parametrize("before", [running, ended, never_run])
def test_an_emergency_stop_outlives_every_reset_but_the_one_that_releases_it(
    before: Callable[[EpisodeRunner], None],
) -> None:
    world = Line()
    service, runner, node = serve(world)
    before(runner)
    stop_for_emergency(runner)
    episode = runner.running
    for driver in ("policy", "expert", "teleop"):
        with pytest.raises(ServiceError) as caught:
            service.reset(ResetRequest(seed=2, driver=driver))
        assert str(caught.value) == LATCHED.format(1)
    assert runner.running is episode, "a refused reset ends nothing"
    assert not node.published
    assert service.detail()["emergency_stop"] == 1
    service.reset(ResetRequest(seed=2, release_emergency_stop=1))
    assert service.detail()["emergency_stop"] == 0
    answer(runner)
    assert world.moves == [("forward", 1.0, TICK_S)]


def test_a_latched_robot_stands_in_whatever_episode() -> None:
    world = Line()
    runner, _, _ = begin(world)
    runner.end(None)
    assert stop_for_emergency(runner) == []
    runner.reset(ResetRequest(seed=2))
    # It stands, says so once, and renders nothing for those who go on commanding.
    for _ in range(20):
        assert answer(runner) == []
    (applied,) = runner.poll()
    assert isinstance(applied, CommandApplied)
    assert (applied.reason, applied.answered_tick, applied.latency_ns) == ("emergency_stop", None, None)
    assert not list(runner.poll())
    assert world.moves == []


def test_in_real_time_a_stop_holds_from_the_next_step_on() -> None:
    world = Line()
    runner, clock, _ = begin(world, mode="realtime")
    answer(runner)
    advance(runner, clock, 0.06)
    driven = len(world.moves)
    runner.gate.stop()
    messages = advance(runner, clock, 0.1)
    assert {move[0] for move in world.moves[driven:]} == {"stop"}
    assert next(m for m in messages if isinstance(m, CommandApplied)).reason == "emergency_stop"


def test_after_a_takeover_the_driver_goes_on_when_it_is_told_to() -> None:
    world = Line()
    service, runner, node = serve(world)
    service.reset(ResetRequest(seed=1))
    run = runner.running
    assert run is not None
    header = Message(robot="r", episode=run.id, tick=0, stamp_ns=0)
    list(service.handle(Command.after(header, source="teleop", atom="left")))
    answer(runner)
    assert world.moves[-1][0] == "left"
    for _ in range(8):
        answer(runner)
    assert service.detail()["taken_over"] is True
    assert world.moves[-1][0] == "stop"
    assert [m.reason for m in node.published if isinstance(m, CommandApplied)][-1:] != ["command"]
    for episode, tick in (("other", 9), (run.id, 0)):
        list(service.handle(Command.after(header.model_copy(update={"tick": run.tick}), source="teleop", atom="stop")))
        with pytest.raises(ServiceError, match="another episode has begun, or the person has commanded since"):
            service.resume(ResumeRequest(episode=episode, tick=tick))
    with pytest.raises(ServiceError) as caught:
        service.reset(ResetRequest(seed=2))
    assert str(caught.value) == TAKEN_OVER
    service.resume(ResumeRequest(episode=run.id, tick=run.tick))
    answer(runner)
    assert world.moves[-1][0] == "forward"


def test_a_stop_that_comes_while_a_step_is_told_of_ends_that_step() -> None:
    world = Line()
    runner, _, _ = begin(world)
    run = runner.running
    assert run is not None
    header = Message(robot="r", episode=run.id, tick=0, stamp_ns=0)
    for message in runner.offer(Command.after(header, source="policy", atom="forward")):
        assert isinstance(message, CommandApplied)
        runner.gate.stop()
    assert world.moves == []
    assert [m.reason for m in runner.poll() if isinstance(m, CommandApplied)] == ["emergency_stop"]


class Broken(Line):
    """A world that fails once."""

    def __init__(self, where: str) -> None:
        super().__init__()
        self.where: str | None = where

    def fail(self, where: str) -> None:
        if self.where == where:
            self.where = None
            raise RuntimeError(where)

    def carry_away(self) -> PlanarPose:
        self.fail("carry_away")
        return super().carry_away()

    def render(self) -> NDArray[np.uint8]:
        self.fail(f"render at {self.x:.1f}")
        return super().render()


@pytest.mark.parametrize("where", ["carry_away", "render at 0.4"])
def test_an_episode_whose_next_frame_cannot_be_made_ends(where: str) -> None:
    runner, _, _ = begin(Broken(where), kidnap_tick=2 if where == "carry_away" else None)
    answer(runner)
    run = runner.running
    assert run is not None
    sent: list[Message] = []
    header = Message(robot="r", episode=run.id, tick=1, stamp_ns=0)
    with pytest.raises(RuntimeError, match=where):
        sent.extend(runner.offer(Command.after(header, source="policy", atom="forward")))
    assert events(sent) == [("ended", "aborted")]
    assert runner.running is None
    assert not list(runner.poll())


def test_a_reset_that_fails_leaves_no_episode_that_nobody_knows_of() -> None:
    world = Broken("never")
    service, runner, node = serve(world)
    service.reset(ResetRequest(seed=1))
    world.where = "render at 0.0"
    with pytest.raises(RuntimeError):
        service.reset(ResetRequest(seed=2, mode="realtime"))
    assert events(node.published)[-1] == ("ended", "aborted"), "the one before has ended all the same"
    assert runner.running is None
    assert not list(runner.poll())


def test_the_time_to_each_accepted_command_is_counted_once() -> None:
    service, runner, node = serve(Line())
    service.reset(ResetRequest(seed=1, mode="realtime"))
    run = runner.running
    assert run is not None
    header = Message(robot="r", episode=run.id, tick=0, stamp_ns=0)
    clock = cast("Clock", runner._clock)
    clock.now_s += 0.03
    list(service.handle(Command.after(header, source="policy", atom="forward")))
    for _ in range(20):
        clock.now_s += STEP_S
        service.poll()
    assert len([m for m in node.published if isinstance(m, CommandApplied) and m.answered_tick == 0]) > 1
    assert node.decisions == [("policy", pytest.approx(0.03))]


def test_status_is_told_while_commands_are_being_refused() -> None:
    service, runner, _ = serve(Line())
    runner.reset(ResetRequest(seed=1))

    stop = threading.Event()

    def refuse() -> None:
        while not stop.is_set():
            runner.gate.refused.clear()
            for reason in get_args(Refusal):
                runner.gate.refused[reason] += 1

    thread = threading.Thread(target=refuse)
    thread.start()
    try:
        for _ in range(300):
            service.detail()
    finally:
        stop.set()
        thread.join()
    assert service.detail()["refused stale"] == 1


def test_who_comes_after_the_frame_was_made_gets_its_picture_when_it_is_sent_again() -> None:
    """Otherwise a features service that needs depth could never answer the first frame, and lockstep would stand."""
    clock, wanted = Clock(), set[Topic]()
    runner = EpisodeRunner(Watched(), "r", "s", clock, lambda: 5, wanted=wanted.__contains__)
    _, sent = runner.reset(ResetRequest(seed=1))
    assert not [m for m in sent if isinstance(m, DepthImage)]
    wanted.add(DEPTH)
    clock.now_s += RESEND_S + 0.1
    pose, depth, image = runner.poll()
    assert isinstance(depth, DepthImage)
    assert (pose.tick, depth.tick, image.tick) == (0, 0, 0)
    assert depth.stamp_ns == image.stamp_ns
    assert isinstance(image, Image)


def test_listeners_are_asked_for_before_the_first_frame() -> None:
    """The first answer is always no."""
    asked: set[Topic] = set()

    def wanted(topic: Topic) -> bool:
        asked.add(topic)
        return False

    EpisodeRunner(Watched(), "r", "s", Clock(), lambda: 5, wanted=wanted)
    assert asked == {DEPTH, OVERHEAD}
