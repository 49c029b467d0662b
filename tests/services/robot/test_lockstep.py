"""Lockstep: each frame waits for its answer, moves the world by one tick, and ends the episode where it does."""

import pytest

from schemas.base import TICK_S, Message
from schemas.camera import CameraInfo, CompressedImage, DepthImage
from schemas.command import CommandApplied
from schemas.episode import Episode
from schemas.motion import Imu, Odometry, TruePose
from schemas.rpc import ArmRequest
from schemas.topics import DEPTH, Topic
from services.kit.cameras import camera_of
from services.robot.lockstep import GIVE_UP_S, RESEND_S
from tests.services.robot.driving import answer, begin, command, events
from tests.services.robot.line import Clock, LineBody

Event = tuple[str, str | None]


def test_it_waits_for_each_answer_and_moves_exactly_one_tick() -> None:
    clock = Clock()
    body = LineBody(clock)
    runner, messages = begin(body)
    assert [type(m) for m in messages] == [
        Episode, CameraInfo, Odometry, Imu, TruePose, CompressedImage,
    ]  # fmt: skip
    (info,) = (m for m in messages if isinstance(m, CameraInfo))
    assert (info.width, info.height, info.centre_x_px, info.centre_y_px) == (32, 24, 16.0, 12.0)
    assert camera_of(info) == LineBody.camera
    clock.now_s += RESEND_S / 2
    assert not list(runner.poll())
    messages = answer(runner)
    assert [type(m) for m in messages] == [CommandApplied, Odometry, Imu, TruePose, CompressedImage]
    assert body.moves == [("forward", 1.0, TICK_S)]
    assert messages[0].latency_ns == pytest.approx(1e9 * RESEND_S / 2)
    assert [m.tick for m in messages] == [0, 1, 1, 1, 1]
    assert messages[1].stamp_ns == 5 + 100_000_000


def test_it_sends_a_lost_frame_again_and_then_gives_up() -> None:
    clock = Clock()
    runner, first = begin(LineBody(clock))
    clock.now_s += RESEND_S + 0.1
    assert list(runner.poll()) == first[4:6]
    clock.now_s += 0.1
    assert not list(runner.poll())
    clock.now_s += GIVE_UP_S
    assert events(list(runner.poll())) == [("ended", "aborted")]


def test_late_listener_gets_its_picture_when_a_frame_is_resent() -> None:
    clock = Clock()
    wanted = set[Topic]()
    runner, sent = begin(LineBody(clock, wanted=wanted.__contains__))
    assert not [m for m in sent if isinstance(m, DepthImage)]
    wanted.add(DEPTH)
    clock.now_s += RESEND_S + 0.1
    pose, depth, image = runner.poll()
    assert isinstance(depth, DepthImage)
    assert (pose.tick, depth.tick, image.tick) == (0, 0, 0)
    assert depth.stamp_ns == image.stamp_ns
    assert isinstance(image, CompressedImage)


FOUND: Event = ("victim_found", None)
ENDED = {name: ("ended", name) for name in ("found", "aborted", "collision", "timeout")}


@pytest.mark.parametrize(
    ("line", "asked", "atoms", "told"),
    [
        ({"goal": 0.3}, {}, 2, [FOUND, ENDED["found"]]),
        # A demonstration goes on after the goal is reached; it has reached it where it ends there, or came back.
        ({"goal": 0.3}, {"purpose": "drive"}, 3, [FOUND, ENDED["found"]]),
        ({"goal": 0.3, "sight": 0.2}, {"purpose": "drive"}, 3, [FOUND, ENDED["aborted"]]),
        ({"goal": 0.3, "sight": 0.2}, {"purpose": "drive"}, -1, [FOUND, ENDED["found"]]),
        # The last frame allowed is a goal if it shows it.
        ({"goal": 0.3}, {"purpose": "recovery", "max_ticks": 3}, 3, [FOUND, ENDED["found"]]),
        ({"goal": 0.3, "sight": 0.2}, {"purpose": "drive", "max_ticks": 3}, 3,
         [FOUND, ("timed_out", None), ENDED["timeout"]]),
        ({"wall": 0.1}, {}, 1, [("collision", None), ENDED["collision"]]),
        ({"wall": 0.1, "goal": 0.1}, {}, 1, [FOUND, ("collision", None), ENDED["collision"]]),
        ({}, {"max_ticks": 1}, 1, [("timed_out", None), ENDED["timeout"]]),
    ],
)  # fmt: skip
def test_how_an_episode_ends(
    line: dict[str, float], asked: dict[str, object], atoms: int, told: list[Event]
) -> None:
    """After so many steps forward, or three and one back; then a demonstration is ended."""
    runner, _ = begin(LineBody(Clock(), **line), **asked)
    said: list[Event] = []
    for atom in ["forward"] * 3 + ["backward"] if atoms < 0 else ["forward"] * atoms:
        said += events(answer(runner, atom))
    if runner.running is not None:
        said += events(runner.end())
    assert said == told


def test_stopped_robot_stands_and_renders_nothing() -> None:
    body = LineBody(Clock())
    runner, _ = begin(body)
    runner.gate.stop()
    (applied,) = runner.poll()
    facts = (applied.reason, applied.answered_tick, applied.latency_ns)
    assert facts == ("latched_stop", None, None)
    for _ in range(20):
        assert answer(runner) == []
    assert not list(runner.poll())
    assert body.moves == []
    runner.arm(ArmRequest(stop=runner.gate.latched_stop))
    assert {
        atom
        for _ in range(3)
        for m in answer(runner)
        if isinstance(m, CommandApplied)
        for atom in [m.atom]
    } == {"stop"}, "released is not told to go on"


def test_stop_during_a_step_ends_that_step() -> None:
    body = LineBody(Clock())
    runner, _ = begin(body)
    runner.offer(command(runner))
    for message in runner.poll():
        assert isinstance(message, CommandApplied)
        runner.gate.stop()
    assert body.moves == []
    assert [m.reason for m in runner.poll() if isinstance(m, CommandApplied)] == ["latched_stop"]


class Broken(LineBody):
    """A body whose picture fails once at a place."""

    fails_at = -1.0

    def render(self, x: float) -> None:
        if abs(x - self.fails_at) < 0.01:
            self.fails_at = -1.0
            raise RuntimeError("no picture")


def test_episode_ends_when_its_next_frame_fails() -> None:
    body = Broken(Clock())
    runner, _ = begin(body)
    answer(runner)
    body.fails_at = 0.4
    runner.offer(command(runner))
    sent: list[Message] = []
    with pytest.raises(RuntimeError, match="no picture"):
        sent.extend(runner.poll())
    assert events(sent) == [("ended", "aborted")]
    assert runner.fault == "internal error; see the log of robot"
    assert runner.running is None
    assert not list(runner.poll())
