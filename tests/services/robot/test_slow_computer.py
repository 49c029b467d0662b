"""A simulated robot on a computer that is too slow for real time: its clock waits, its wheels do not stand."""

from collections.abc import Callable

import pytest

from schemas.base import Message
from schemas.command import CommandApplied
from schemas.episode import Episode
from schemas.rpc import ResetRequest
from services.robot.clock import PATIENCE_S, SILENCE_S, Clocks, SimulatedClock
from services.robot.loop import PERIOD_S
from services.robot.runner import EpisodeRunner
from tests.services.robot.driving import Runner, SteppedRealTime, armed, command
from tests.services.robot.line import Clock, LineBody, LineView, Reach

GOAL_M = 10.0  # Five seconds at full speed.


class SlowBody(LineBody):
    """A body that renders slowly."""

    spend: Callable[[], None] = staticmethod(lambda: None)

    def render(self, x: float) -> None:
        self.spend()


def slow_runner(wall: Clock, render_s: float, *, waits: bool) -> Runner:
    """Return a runner whose clock waits, or passes like real time."""
    simulated = SimulatedClock(wall)
    clock: Callable[[], float] = simulated if waits else wall
    clocks = Clocks(clock, lambda: 5, simulated.hold)
    body = SlowBody(clock, goal=GOAL_M)

    def spend() -> None:
        wall.now_s += render_s

    body.spend = spend
    gate = armed()
    pace = SteppedRealTime(gate, body, clock, lambda: None, hold=clocks.hold)
    runner: Runner = EpisodeRunner[LineView](
        body, Reach(), gate, "r", "s", paces={"realtime": lambda: pace}, clocks=clocks
    )
    runner.reset(ResetRequest(seed=1, mode="realtime", max_ticks=80))
    return runner


def driven(runner: Runner, wall: Clock, answers_s: float, until_s: float = 300.0) -> list[Message]:
    """Drive ahead with a policy that takes its time; return all messages."""
    assert runner.running is not None
    pace = runner.running.pace
    assert isinstance(pace, SteppedRealTime)
    messages: list[Message] = []
    answered = -1
    answer = command(runner)
    ready_s = wall.now_s + answers_s
    end_s = wall.now_s + until_s
    while runner.running is not None and wall.now_s < end_s:
        wall.now_s += PERIOD_S
        pace.loop.step()
        messages += runner.poll()
        if answered < answer.tick and wall.now_s >= ready_s:
            runner.offer(answer)
            answered = answer.tick
        if runner.running is not None and answered == answer.tick < runner.running.tick:
            # It goes on with the newest frame.
            answer = command(runner)
            ready_s = wall.now_s + answers_s
    return messages


def reasons(messages: list[Message]) -> set[str]:
    return {str(one.reason) for one in messages if isinstance(one, CommandApplied)}


@pytest.mark.parametrize(("render_s", "answers_s"), [(0.0, 0.6), (0.5, 0.0), (0.4, 0.4)])
def test_slow_run_ends_as_found_when_the_clock_waits(render_s: float, answers_s: float) -> None:
    wall = Clock()
    began_s = wall.now_s
    runner = slow_runner(wall, render_s, waits=True)
    messages = driven(runner, wall, answers_s)
    ended = [one for one in messages if isinstance(one, Episode)][-1]
    assert ended.outcome == "found"
    # It begins to drive with the first answer, and is never silent again.
    moved = [one for one in messages if isinstance(one, CommandApplied)]
    first = next(number for number, one in enumerate(moved) if one.linear)
    assert reasons(moved[first:]) == {"command"}
    assert 50 <= ended.tick <= 60
    assert ended.tick / (wall.now_s - began_s) < 5.0  # Frames a second of real time.


def test_slow_run_stands_again_and_again_without_waiting() -> None:
    wall = Clock()
    messages = driven(slow_runner(wall, 0.0, waits=False), wall, 0.6)
    ended = [one for one in messages if isinstance(one, Episode)][-1]
    assert ended.outcome == "timeout"
    assert "command" not in reasons(messages)


def test_fast_run_keeps_real_time_when_the_clock_can_wait() -> None:
    wall = Clock()
    runner = slow_runner(wall, 0.015, waits=True)
    began_s = wall.now_s
    messages = driven(runner, wall, 0.05)
    ended = [one for one in messages if isinstance(one, Episode)][-1]
    assert ended.outcome == "found"
    assert ended.tick / (wall.now_s - began_s) == pytest.approx(10.0, rel=0.05)


def test_robot_stands_when_a_slow_driver_falls_silent() -> None:
    wall = Clock()
    runner = slow_runner(wall, 0.0, waits=True)
    driven(runner, wall, 0.1, until_s=2.0)
    body = runner.body
    assert isinstance(body, LineBody)
    began_s = body.clock()
    at_m = body.x
    driven(runner, wall, 1e9, until_s=PATIENCE_S + 1.0)
    assert body.orders[-1] == ("stop", 0.0)
    assert body.x - at_m <= 2.0 * (SILENCE_S + 2 * PERIOD_S)  # At 2 m/s, by the robot's own clock.
    assert body.clock() - began_s < 1.5


def test_simulated_clock_passes_after_its_patience() -> None:
    wall = Clock()
    clock = SimulatedClock(wall)
    start_s = clock()
    clock.hold(start_s + 0.1)
    wall.now_s += 1.0
    assert clock() == pytest.approx(start_s + 0.1)
    wall.now_s += PATIENCE_S
    clock()
    wall.now_s += 0.5
    assert clock() == pytest.approx(start_s + 0.6)
    clock.hold(clock() + 0.1)
    wall.now_s += 1.0
    assert clock() == pytest.approx(start_s + 0.7)
