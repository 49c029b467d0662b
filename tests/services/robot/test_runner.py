"""Episodes of a robot on a line: motion, messages in real time, and how an episode ends."""

from dataclasses import replace

import numpy as np
import pytest

from schemas.base import Message
from schemas.camera import CameraInfo, CompressedImage, DepthImage
from schemas.command import CommandApplied
from schemas.episode import Episode
from schemas.heartbeat import Heartbeat
from schemas.motion import Imu, Odometry, TruePose
from schemas.rpc import CarryRequest, EndRequest, ResetRequest, ResumeRequest, TaskRequest
from services.kit.jpeg import decode_jpeg, encode_jpeg
from services.kit.node import ServiceError
from services.robot.gate import MAX_AGE_S
from services.robot.loop import PERIOD_S
from services.robot.radio import coarse
from services.robot.runner import EpisodeRunner
from services.robot.task import OperatorsTask
from tests.schemas.messages import HEADER
from tests.services.robot.driving import (
    Runner,
    SteppedRealTime,
    advance,
    answer,
    armed,
    begin,
    command,
    events,
    reset,
    runner_of,
)
from tests.services.robot.line import Clock, LineBody, LineView


def applied(messages: list[Message]) -> list[CommandApplied]:
    return [m for m in messages if isinstance(m, CommandApplied)]


@pytest.mark.parametrize(("frames_hz", "many"), [(10.0, {19, 20}), (2.0, {3, 4})])
def test_so_many_frames_a_second_whether_commanded_or_not(frames_hz: float, many: set[int]) -> None:
    clock = Clock()
    runner = runner_of(LineBody(clock))
    runner.frame_s = 1.0 / frames_hz
    first = reset(runner, mode="realtime")
    assert [type(m) for m in first] == [
        Episode, CameraInfo, Odometry, Imu, TruePose, CompressedImage,
    ]  # fmt: skip
    images = [m for m in advance(runner, clock, 2.0) if isinstance(m, CompressedImage)]
    assert len(images) in many


def test_radio_sends_small_pictures_and_few_unanswered() -> None:
    clock = Clock()
    _, whole = begin(LineBody(clock), mode="realtime")
    runner = runner_of(LineBody(clock))
    runner.radio = True
    runner.jpeg_quality = 1
    first = reset(runner, mode="realtime")
    assert first[-1].data == encode_jpeg(decode_jpeg(whole[-1].data), 1)

    def pictures(seconds: float) -> int:
        return sum(
            isinstance(message, CompressedImage) for message in advance(runner, clock, seconds)
        )

    assert pictures(2.0) in {4, 5, 6}, "three at once; what was lost is not waited for"
    answered = 0
    for _ in range(20):
        answer(runner)
        answered += pictures(0.1)
    assert answered in {19, 20}
    answer(runner, source="teleop")
    assert pictures(2.0) in {19, 20}, "a person who drives answers none"


def test_radio_depth_image_is_a_sample_of_the_whole() -> None:
    whole = np.arange(240 * 320, dtype="<u2").reshape(240, 320)
    depth = DepthImage(**HEADER, width=320, height=240, data=whole.tobytes())
    small = DepthImage.model_validate(dict(coarse(depth)))
    assert (small.width, small.height) == (40, 30)
    np.testing.assert_array_equal(small.to_numpy(), whole[4::8, 4::8])
    assert coarse(small) == small


def test_body_without_sensors_sends_no_readings() -> None:
    body = LineBody(Clock())
    body.senses = False
    body.camera = None
    _, first = begin(body, mode="realtime")
    assert [type(m) for m in first] == [Episode, TruePose, CompressedImage]


class Ahead(LineBody):
    """A body whose camera's clock is ahead of the actuator's."""

    def look(self, tick: int) -> LineView:
        view = super().look(tick)
        return replace(view, captured_s=view.captured_s + 5.0)


@pytest.mark.parametrize("body_of", [LineBody, Ahead])
def test_silence_stops_the_robot_within_half_a_second(body_of: type[LineBody]) -> None:
    clock = Clock()
    body = body_of(clock)
    runner, _ = begin(body, mode="realtime")
    answer(runner)
    messages = advance(runner, clock, 1.5)
    moving = [duration for atom, _, duration in body.moves if atom == "forward"]
    assert MAX_AGE_S - 2 * PERIOD_S <= sum(moving) <= MAX_AGE_S + PERIOD_S + 1e-9
    assert body.moves[-1][0] == "stop"
    told = applied(messages)
    assert (told[0].reason, told[-1].reason) == ("command", "silence")


def test_stamps_are_capture_times_when_the_wall_clock_jumps() -> None:
    clock = Clock()
    wall_ns = iter([7_000_000_000])
    runner = runner_of(LineBody(clock), wall_clock_ns=lambda: next(wall_ns))
    reset(runner, mode="realtime")
    captured_s = {}
    for _ in range(3):
        clock.now_s += 0.35  # slower than real time: the stamps are true all the same
        captured_s |= {
            (m.tick, clock.now_s): m.stamp_ns
            for m in runner.poll()
            if isinstance(m, CompressedImage)
        }
    assert len(captured_s) == 3, "one each time, and none is made up for"
    assert isinstance(runner.running.pace, SteppedRealTime)
    assert runner.running.pace.late == 3
    assert all(
        stamp_ns == 7_000_000_000 + round(1e9 * (now_s - 100.0))
        for (_, now_s), stamp_ns in captured_s.items()
    )


def test_latency_belongs_to_the_frame_that_was_answered() -> None:
    clock = Clock()
    runner, _ = begin(LineBody(clock), mode="realtime")
    told: list[CommandApplied] = []
    for tick in range(5):
        clock.now_s += 0.01 * (tick + 1)
        runner.offer(command(runner, tick=tick))
        while runner.running is not None and runner.running.tick == tick:
            told += applied(advance(runner, clock, PERIOD_S))
    latencies: dict[int | None, set[int | None]] = {}
    for message in told:
        latencies.setdefault(message.answered_tick, set()).add(message.latency_ns)
    for tick in range(5):
        assert list(latencies[tick]) == [pytest.approx(1e7 * (tick + 1))]
    delays = [m.delay_ns for m in told if m.answered_tick == 4]
    assert delays, "and no older when it is told again"
    assert all(delay == pytest.approx(1e9 * (0.05 + PERIOD_S), abs=1e7) for delay in delays)


class SlowLine(LineBody):
    """A body whose pictures take 0.1 s."""

    def render(self, x: float) -> None:
        self.clock.now_s += 0.1


def test_slow_pictures_do_not_prolong_a_command() -> None:
    for answered in range(1, 30):
        clock = Clock()
        body = SlowLine(clock)
        runner, _ = begin(body, mode="realtime")
        while runner.running is not None and runner.running.tick < answered:
            answer(runner)
            advance(runner, clock, PERIOD_S)
        captured_s = runner.running.episode.view.captured_s
        runner.offer(command(runner))
        advance(runner, clock, 2.0)
        stood_s = max(
            at
            for at, atom in zip(order_times(body), body.orders, strict=True)
            if atom[0] == "forward"
        )
        assert captured_s < stood_s <= captured_s + MAX_AGE_S + 1e-9


def order_times(body: LineBody) -> list[float]:
    at_s = 100.0
    times = []
    for _, _, duration in body.moves[-len(body.orders) :]:
        at_s += duration
        times.append(at_s)
    return times


def test_a_stop_holds_from_the_next_step_on() -> None:
    clock = Clock()
    body = LineBody(clock)
    runner, _ = begin(body, mode="realtime")
    answer(runner)
    advance(runner, clock, 0.06)
    given = len(body.orders)
    runner.gate.stop()
    messages = advance(runner, clock, 0.1)
    assert {atom for atom, _ in body.orders[given:]} == {"stop"}
    assert applied(messages)[0].reason == "latched_stop"
    assert applied(messages)[0].stop_cause == "emergency_stop"


def test_the_end_of_an_episode_is_standing_still() -> None:
    clock = Clock()
    body = LineBody(clock)
    runner, _ = begin(body, mode="realtime")
    answer(runner)
    advance(runner, clock, 0.04)
    assert body.orders[-1][0] == "forward"
    runner.end()
    assert body.orders[-1] == ("stop", 0.0)


@pytest.mark.parametrize(
    ("goal", "frames", "said", "outcome", "right"),
    [
        (0.3, 3, "found", "found", None),
        (0.3, 1, "found", "false_goal", None),
        (0.3, 3, "not_here", "not_here", False),
        (1e9, 3, "not_here", "not_here", True),
        (1e9, 3, "found", "false_goal", None),
    ],
)
def test_report_of_the_robot_ends_its_run_and_is_judged(
    goal: float, frames: int, said: str, outcome: str, right: bool | None
) -> None:
    runner, _ = begin(LineBody(Clock(), goal=goal), until_said=True)
    for _ in range(frames):
        assert ("ended", "found") not in events(answer(runner)), "it has said nothing yet"
    run = runner.running
    (ended,) = runner.end_by(EndRequest.model_validate({"episode": run.id, "said": said}))
    assert (ended.outcome, ended.right) == (outcome, right)


@pytest.mark.parametrize(("goal", "outcome"), [(0.3, "missed"), (1e9, "timeout")])
def test_run_is_missed_when_the_robot_passes_the_goal_silently(goal: float, outcome: str) -> None:
    runner, _ = begin(LineBody(Clock(), goal=goal, sight=0.2), until_said=True, max_ticks=8)
    assert [e for _ in range(8) for e in events(answer(runner))][-2:] == [
        ("timed_out", None),
        ("ended", outcome),
    ]


@pytest.mark.parametrize(("goal", "outcome"), [(0.1, "missed"), (1e9, "aborted")])
def test_run_is_missed_when_a_person_ends_it_without_a_report(goal: float, outcome: str) -> None:
    runner, _ = begin(LineBody(Clock(), goal=goal), until_said=True)
    for _ in range(4):
        answer(runner)
    run = runner.running
    assert events(runner.end_by(EndRequest(episode=run.id))) == [("ended", outcome)]


def test_where_a_person_says_that_the_goal_is_it_is() -> None:
    runner, _ = begin(LineBody(Clock(), goal=1e9), purpose="drive", driver="teleop")
    for _ in range(3):
        answer(runner, source="teleop")
    drive = runner.running
    runner.end_by(EndRequest(episode=drive.id, found=True))
    reset(runner, until_said=True)
    for _ in range(3):
        answer(runner)
    run = runner.running
    assert events(runner.end_by(EndRequest(episode=run.id, said="found"))) == [("ended", "found")]


def test_report_is_not_judged_when_there_is_no_task() -> None:
    runner = runner_of(LineBody(Clock()), task=OperatorsTask())
    reset(runner, until_said=True)
    run = runner.running
    assert events(runner.end_by(EndRequest(episode=run.id, said="found"))) == [("ended", "aborted")]


def test_a_robot_without_a_task_goes_on_past_every_goal() -> None:
    runner = runner_of(LineBody(Clock(), goal=0.3), task=OperatorsTask())
    reset(runner, max_ticks=5)
    assert [e for _ in range(5) for e in events(answer(runner))] == [
        ("timed_out", None),
        ("ended", "timeout"),
    ]


def test_a_drive_of_a_person_has_no_time_limit() -> None:
    runner = runner_of(LineBody(Clock(), goal=1e9))
    reset(runner, max_ticks=None)
    for _ in range(3100):
        assert not events(answer(runner))
    assert runner.running.tick == 3100


def test_corrected_run_does_not_time_out() -> None:
    clock = Clock()
    runner, _ = begin(LineBody(clock, goal=1e9), mode="realtime", max_ticks=5)
    advance(runner, clock, 0.2)
    answer(runner, "left", source="teleop")
    assert not events(advance(runner, clock, 3.0))
    run = runner.running
    runner.resume(ResumeRequest(episode=run.id, tick=run.tick))
    assert not events(advance(runner, clock, 0.2))
    assert events(advance(runner, clock, 0.2)) == [("timed_out", None), ("ended", "timeout")]


def test_run_does_not_time_out_while_it_stands_for_its_operator() -> None:
    clock = Clock()
    runner, _ = begin(LineBody(clock, goal=1e9), mode="realtime", max_ticks=5)
    runner.gate.stop("operator_lost")
    assert not events(advance(runner, clock, 3.0))
    run = runner.running
    runner.gate.arm(runner.gate.latched_stop, "")
    runner.resume(ResumeRequest(episode=run.id, tick=run.tick))
    assert events(advance(runner, clock, 1.0))[-1] == ("ended", "timeout")


class CarriedBody(LineBody):
    """A robot on a line that a person can carry along it."""

    @property
    def pose(self) -> tuple[float, float, float]:
        return self.x, 0.0, 0.0

    def carry(self, x_m: float, y_m: float, heading_rad: float) -> None:
        self.x = x_m

    def choose_task(self, start: tuple[float, float], goal: tuple[float, float]) -> None:
        self.x = start[0]
        self.goal = goal[0]


def carry(runner: Runner, session: str = "") -> None:
    runner.carry(CarryRequest(x_m=7.0, y_m=0.0, heading_rad=0.0, session=session))


def test_run_reports_its_kidnapping_when_it_was_carried() -> None:
    runner, first = begin(CarriedBody(Clock()))
    assert ("kidnapped", None) not in events(first)
    carry(runner)
    frame = answer(runner)
    assert ("kidnapped", None) in events(frame)
    assert next(one for one in frame if isinstance(one, TruePose)).x_m > 7.0
    assert ("kidnapped", None) not in events(answer(runner))
    runner, _ = begin(CarriedBody(Clock()), kidnap_tick=1)
    assert ("kidnapped", None) in events(answer(runner)), "by request as well"


def test_robot_is_not_carried_when_that_is_no_simulated_run() -> None:
    runner, _ = begin(LineBody(Clock()))
    with pytest.raises(ServiceError, match="only a simulated robot can be carried"):
        carry(runner)
    runner, _ = begin(CarriedBody(Clock()), purpose="drive", driver="teleop")
    with pytest.raises(ServiceError, match="this drive would teach a wrong way"):
        carry(runner)
    task = TaskRequest(start=(2.0, 0.0), goal=(9.0, 0.0))
    with pytest.raises(ServiceError, match="an episode runs"):
        runner.choose_task(task)
    runner = runner_of(CarriedBody(Clock()), armed(attended=True))
    carry(runner)  # before an episode
    assert runner.body.x == 7.0
    runner.choose_task(task)
    assert (runner.body.x, runner.body.goal) == (2.0, 9.0)
    pulse = runner.pulse()
    own = {"session": "a", "name": "console", "sequence": 0, "answers": pulse.number}
    runner.hear(Heartbeat.after(pulse, **own))
    with pytest.raises(ServiceError, match="only the operator"):
        carry(runner, "another")


def test_unknown_mode_is_refused_in_one_line() -> None:
    runner: EpisodeRunner[LineView] = EpisodeRunner(
        LineBody(Clock()), OperatorsTask(), armed(), "r", "s"
    )
    with pytest.raises(ServiceError, match="line: unsupported mode lockstep; use realtime"):
        runner.reset(ResetRequest(seed=1))
    assert runner.running is None
