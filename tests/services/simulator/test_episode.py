"""Episodes of a robot in a world without pixels: lockstep, real time, and every way to end."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from schemas.base import Atom, Message
from schemas.command import Command, CommandApplied
from schemas.episode import Episode, Purpose
from schemas.image import Image
from schemas.pose import Pose
from schemas.rpc import ResetRequest
from services.simulator.episode import GIVE_UP_S, RESEND_S, STEP_S, TICK_S, EpisodeRunner
from services.simulator.world.terrain import Pose as PlanarPose


class Line:
    """A world of one dimension: a victim at ``victim`` and a wall at ``wall`` on a line."""

    name = "line"

    def __init__(self, victim: float = 1e9, wall: float = 1e9) -> None:
        self.x, self.victim, self.wall = 0.0, victim, wall
        self.moves: list[tuple[Atom, float, float]] = []

    def reset(self, seed: int, purpose: Purpose) -> PlanarPose:
        self.x = 0.0
        self.moves.clear()
        return self.pose

    def advance(self, atom: Atom, speed: float, duration_s: float) -> PlanarPose:
        self.moves.append((atom, speed, duration_s))
        self.x += {"forward": 2.0, "backward": -2.0}.get(atom, 0.0) * speed * duration_s
        return self.pose

    def render(self) -> NDArray[np.uint8]:
        return np.full((24, 32, 3), int(10 * self.x) % 256, dtype=np.uint8)

    def victim_found(self) -> bool:
        return self.x >= self.victim

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


def answer(runner: EpisodeRunner, atom: Atom = "forward", tick: int | None = None) -> list[Message]:
    run = runner.running
    assert run is not None
    command = Command(
        robot="r", episode=run.id, tick=run.tick if tick is None else tick, stamp_ns=0, source="policy", atom=atom
    )
    return list(runner.offer(command))


def begin(world: Line, **request: object) -> tuple[EpisodeRunner, Clock, list[Message]]:
    clock = Clock()
    runner = EpisodeRunner(world, "r", "s", clock, lambda: 5)
    _, messages = runner.reset(ResetRequest.model_validate({"seed": 1} | request))
    return runner, clock, messages


def events(messages: list[Message]) -> list[tuple[str, str | None]]:
    return [(m.event, m.outcome) for m in messages if isinstance(m, Episode)]


def test_lockstep_waits_for_each_answer_and_moves_exactly_one_tick() -> None:
    world = Line()
    runner, clock, messages = begin(world)
    assert [type(m) for m in messages] == [Episode, Pose, Image]
    clock.now_s += RESEND_S / 2
    assert not list(runner.poll())
    messages = answer(runner)
    assert [type(m) for m in messages] == [CommandApplied, Pose, Image]
    assert world.moves == [("forward", 1.0, TICK_S)]
    assert isinstance(messages[0], CommandApplied)
    assert messages[0].latency_ns == pytest.approx(1e9 * RESEND_S / 2)
    assert [m.tick for m in messages] == [0, 1, 1]
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
    assert list(runner.poll()) == first[1:]
    clock.now_s += 0.1
    assert not list(runner.poll())
    clock.now_s += GIVE_UP_S
    assert events(list(runner.poll())) == [("ended", "aborted")]


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
    assert 0.4 <= sum(moving) <= 0.5
    assert world.moves[-1][0] == "stop"
    applied = [m for m in messages if isinstance(m, CommandApplied)]
    assert (applied[0].reason, applied[-1].reason) == ("command", "silence")


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
    applied = [m for m in advance(runner, clock, 1.0) if isinstance(m, CommandApplied)]
    assert [m.sequence for m in applied] == sorted({m.sequence for m in applied})
