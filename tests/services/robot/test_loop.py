"""The actuator loop: the robot stands whatever else fails."""

import logging
import threading
from collections.abc import Iterator

import pytest

from schemas.base import Velocity
from schemas.command import Command
from schemas.rpc import ResetRequest
from services.kit.node import ServiceError
from services.robot.clock import now_s
from services.robot.gate import Applied
from services.robot.loop import ActuatorLoop, check_stopping, stopping_times_s
from services.robot.runner import EpisodeRunner
from services.simulator.base import KinematicBase
from services.simulator.body import SimulatedBody
from services.simulator.physics import PhysicalBase
from services.simulator.simulation import Simulation
from services.simulator.world import load_world
from tests.services.robot.driving import advance, answer, armed, command, runner_of
from tests.services.robot.line import Clock, LineBody, Reach
from tests.services.simulator.simulator_driving import StubCamera
from tests.services.waiting import eventually


class Failing(LineBody):
    """A body that does not take some orders."""

    fails: frozenset[str] = frozenset()

    def drive(self, velocity: Velocity) -> Velocity:
        if velocity.atom() in self.fails:
            raise OSError("the wheels do not answer")
        return super().drive(velocity)


def test_a_body_that_fails_stands_until_it_is_armed_again(caplog: pytest.LogCaptureFixture) -> None:
    clock = Clock()
    body = Failing(clock)
    runner = runner_of(body)
    runner.reset(ResetRequest(seed=1, mode="realtime"))
    answer(runner)
    advance(runner, clock, 0.04)
    assert body.orders[-1] == ("forward", 1.0)
    body.fails = frozenset({"forward"})
    with caplog.at_level(logging.ERROR):
        advance(runner, clock, 0.1)
    assert body.orders[-1] == ("stop", 0.0)
    assert (runner.gate.stop_cause, caplog.text.count("the body has failed")) == ("fault", 1)
    assert runner.running is not None
    fault = str(runner.running.pace.detail()["fault"])
    assert fault.startswith("OSError: the wheels do not answer (test_loop.py, line ")
    body.fails = frozenset()
    answer(runner)
    advance(runner, clock, 0.04)
    assert body.orders[-1] == ("stop", 0.0), "it does not try by itself"
    assert runner.gate.arm(runner.gate.latched_stop, "") is None
    assert "fault" not in runner.running.pace.detail()


def test_failed_body_is_left_to_its_watchdog(
    caplog: pytest.LogCaptureFixture,
) -> None:
    body = Failing(Clock())
    body.fails = frozenset({"stop"})
    told: list[Applied] = []
    gate = armed()
    with caplog.at_level(logging.ERROR):
        ActuatorLoop(gate, body, told.append, body.clock).step()
    assert gate.stop_cause == "fault"
    assert "the body has failed" in caplog.text
    assert "the body failed to stand; its watchdog must stop it" in caplog.text
    assert not told


def test_loop_reports_changes_of_the_executed_command() -> None:
    clock = Clock()
    body = LineBody(clock)
    gate = armed()
    told: list[Applied] = []
    loop = ActuatorLoop(gate, body, told.append, clock)
    gate.begin("e", "policy")
    for _ in range(3):
        loop.step()
    gate.captured(0, clock.now_s)
    for atom, speed in (("forward", 1.0), ("forward", 0.5), ("left", 0.5)):
        gate.offer(
            Command(robot="r", episode="e", tick=0, stamp_ns=0, source="policy", sequence=len(told), atom=atom,
                    speed=speed),
            clock.now_s,
        )  # fmt: skip
        for _ in range(3):
            loop.step()
    gate.stop()
    loop.step()
    assert [(one.velocity, one.reason) for one in told] == [
        ((0.0, 0.0), "silence"),
        ((1.0, 0.0), "command"),
        ((0.5, 0.0), "command"),
        ((0.0, 0.5), "command"),
        ((0.0, 0.0), "latched_stop"),
    ]


class Stuck(LineBody):
    """A body whose pictures never come until the test lets them."""

    def __init__(self) -> None:
        super().__init__(now_s)
        self.go_on = threading.Event()
        self.slow = False

    def render(self, x: float) -> None:
        if self.slow:
            self.go_on.wait()


@pytest.fixture
def stuck() -> Iterator[Stuck]:
    body = Stuck()
    yield body
    body.go_on.set()


def test_wheels_stop_when_rendering_hangs(stuck: Stuck) -> None:
    runner = EpisodeRunner(stuck, Reach(), armed(), "r", "s")
    runner.reset(ResetRequest(seed=1, mode="realtime"))
    try:
        runner.offer(command(runner))
        eventually(lambda: stuck.orders[-1:] == [("forward", 1.0)])
        stuck.slow = True

        def poll() -> None:
            while not stuck.go_on.is_set():
                list(runner.poll())

        other = threading.Thread(target=poll, daemon=True)
        other.start()
        eventually(lambda: stuck.orders[-1:] == [("stop", 0.0)])
        assert other.is_alive()
    finally:
        stuck.go_on.set()
        other.join()
        runner.end()


@pytest.mark.parametrize("kind", [KinematicBase, PhysicalBase])
@pytest.mark.parametrize("world", ["campus", "indoor", "yard"])
def test_the_simulated_robots_stand_in_time(
    kind: type[KinematicBase | PhysicalBase], world: str
) -> None:
    there = load_world(world)
    body = SimulatedBody(Simulation(there, StubCamera(), kind(there.place)))
    check_stopping(body)
    assert max(stopping_times_s(body).values()) <= 0.5


def test_all_delays_together_are_checked() -> None:
    body = LineBody(Clock())
    assert stopping_times_s(body) == {
        "the driver": 0.27,
        "the operator": 0.27,
        "a link": 0.27,
        "this process": 0.2,
    }
    check_stopping(body)
    body.braking_s = 0.24
    with pytest.raises(
        ServiceError,
        match=r"line: stopping time after the silence of the driver is too large \(0\.51 s > maximum 0\.5 s",
    ):
        check_stopping(body)
    body.braking_s = 0.0
    body.watchdog_s = 0.6
    with pytest.raises(
        ServiceError, match=r"of this process is too large \(0\.60 s.*its watchdog 0.60 s"
    ):
        check_stopping(body)
    body.watchdog_s = float("nan")
    with pytest.raises(ServiceError, match="of this process"):
        check_stopping(body)
