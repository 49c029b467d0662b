"""Odometry is compared with the executed commands."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.base import STANDING, TICK_S, Velocity
from services.robot.body import Kinematics
from services.robot.gate import CommandGate
from services.robot.loop import ActuatorLoop
from services.robot.wheels import DELAY_S, STARTS_S, WheelCheck
from tests.services.robot.gating import command
from tests.services.robot.line import Clock, LineBody

FULL = Kinematics(2.0, 0.8)
STEP_S = 0.02
AHEAD = Velocity(1.0, 0.0)
LEFT = Velocity(0.0, 1.0)
Orders = list[Velocity]


def compare(
    orders: Orders, report: float, *, delay_s: float = 0.1, starts_s: float = 0.5
) -> tuple[float, str] | None:
    """Drive a base by an order a tick; return when its odometry contradicts the commands, and how.

    The base begins to obey after a delay, and has its full speed after ``starts_s``. Its odometry reports so many times
    what it does.
    """
    wheels = WheelCheck(FULL)
    speed = [0.0, 0.0]
    pose = [0.0, 0.0, 0.0]
    steps = round(TICK_S / STEP_S)
    late = round(delay_s / STEP_S)
    for tick, order in enumerate(orders):
        contradiction = wheels.read(pose, tick * TICK_S)
        if contradiction is not None:
            return tick * TICK_S, contradiction
        wheels.told(order, tick * TICK_S)
        for step in range(steps):
            obeyed = (tick * steps + step - late) // steps
            asked = orders[obeyed] if obeyed >= 0 else STANDING
            for axis in (0, 1):
                change = asked[axis] - speed[axis]
                most = STEP_S / (0.25 if abs(asked[axis]) < abs(speed[axis]) else starts_s)
                speed[axis] += max(-most, min(change, most))
            reported_m = report * speed[0] * FULL.speed_m_s * STEP_S
            pose[0] += reported_m * math.cos(pose[2])
            pose[1] += reported_m * math.sin(pose[2])
            pose[2] += report * speed[1] * FULL.turn_rate_rad_s * STEP_S
    return None


@pytest.mark.parametrize(
    "order", [AHEAD, LEFT, Velocity(-1.0, 0.0), Velocity(0.3, 0.0), Velocity(1.0, -0.5)]
)
@pytest.mark.parametrize(("report", "most_s"), [(0.0, 1.1), (-1.0, 1.1)])
def test_wheels_contradict_when_odometry_lies(
    order: Velocity, report: float, most_s: float
) -> None:
    found = compare([order] * 40, report)
    share = max(map(abs, order))
    assert found[0] * share <= most_s
    assert "does not follow the commands" in found[1]


@pytest.mark.parametrize("starts_s", [0.0, 0.25, 1.0, STARTS_S / 0.8])
@pytest.mark.parametrize("report", [0.7, 1.0, 1.3])
def test_wheels_agree_when_a_base_is_slow(starts_s: float, report: float) -> None:
    orders = [AHEAD] * 20 + [STANDING] * 10 + [LEFT] * 20 + [Velocity(-0.5, 0.0)] * 20
    assert compare(orders, report, delay_s=DELAY_S, starts_s=max(starts_s, STEP_S)) is None


@pytest.mark.parametrize("seed", range(5))
def test_wheels_agree_when_a_base_slips_in_bends(seed: int) -> None:
    """A skid-steered base that drives ahead turns at a third of the commanded rate; its odometry is noisy."""
    rng = np.random.default_rng(seed)
    wheels = WheelCheck(FULL)
    heading = 0.0
    for tick in range(600):
        assert wheels.read((0.2 * tick, 0.0, heading), tick * TICK_S) is None
        bend = 0.45 * math.sin(tick / 20.0)
        wheels.told(Velocity(1.0, bend), tick * TICK_S)
        heading += (bend / 3.0 + rng.normal(0.0, 0.1)) * FULL.turn_rate_rad_s * TICK_S


@given(
    st.lists(
        st.tuples(st.sampled_from([-1.0, 0.0, 0.2, 1.0]), st.sampled_from([-1.0, 0.0, 0.5]), st.integers(1, 8)),
        min_size=1, max_size=12,
    )
)  # fmt: skip
def test_wheels_agree_when_commands_are_arbitrary(asked: list[tuple[float, float, int]]) -> None:
    orders = [Velocity(linear, angular) for linear, angular, ticks in asked for _ in range(ticks)]
    assert compare(orders, 1.0) is None


@pytest.mark.parametrize("reading", [(float("nan"), 0.0, 0.0), (0.0, float("inf"), 0.0)])
def test_wheels_contradict_when_odometry_is_not_finite(reading: tuple[float, float, float]) -> None:
    wheels = WheelCheck(FULL)
    assert wheels.read((0.0, 0.0, 0.0), 0.0) is None
    assert "not finite" in str(wheels.read(reading, 0.1))
    # It still compares afterwards.
    wheels.told(AHEAD, 0.1)
    found = [wheels.read((0.0, 0.0, 0.0), 0.1 * tick) for tick in range(2, 20)]
    assert any(one is not None for one in found)


def test_wheels_agree_when_odometry_was_silent() -> None:
    """A base that hangs for a second neither moves nor reports; then both go on."""
    wheels = WheelCheck(FULL)
    wheels.told(AHEAD, 0.0)
    found = [wheels.read((2.0 * 0.1 * tick, 0.0, 0.0), 0.1 * tick) for tick in range(20)]
    found += [
        wheels.read((3.8 + 2.0 * 0.1 * tick, 0.0, 0.0), 3.0 + 0.1 * tick) for tick in range(20)
    ]
    assert found == [None] * 40


def test_wheels_agree_when_a_base_rolls_on_after_its_order() -> None:
    """Half a second of every second ahead, by a base that begins late: each pulse is driven, and reported, in full."""
    pulses = ([AHEAD] * 5 + [STANDING] * 5) * 12
    assert compare(pulses, 1.0, delay_s=0.4) is None


def test_loop_compares_the_executed_command_when_it_is_refused() -> None:

    class Refusing(LineBody):
        def drive(self, velocity: Velocity) -> Velocity:
            return super().drive(STANDING)

    clock = Clock()
    gate = CommandGate(first_stop=1)
    body = Refusing(clock)
    gate.wheels = WheelCheck(body.kinematics)
    assert gate.arm(1, "") is None
    gate.begin("e", "policy")
    loop = ActuatorLoop(gate, body, lambda _: None, clock)
    for tick in range(30):
        clock.now_s += TICK_S
        gate.captured(tick, clock.now_s)
        assert gate.wheels.read((body.x, 0.0, 0.0), clock.now_s) is None
        assert gate.offer(command(tick), clock.now_s) is None
        loop.step()
