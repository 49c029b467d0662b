"""The odometry must follow what the base carries out."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.base import STANDING, Velocity
from services.robot.body import Kinematics
from services.robot.wheels import DELAY_S, STARTS_S, Wheels

FULL = Kinematics(2.0, 0.8)
TICK_S, STEP_S = 0.1, 0.02
AHEAD, LEFT = Velocity(1.0, 0.0), Velocity(0.0, 1.0)
Orders = list[Velocity]


def compare(orders: Orders, report: float, *, delay_s: float = 0.1, starts_s: float = 0.5) -> tuple[float, str] | None:
    """Drive a base by an order a tick; return when its odometry contradicts the commands, and how.

    The base begins to obey after a delay, and has its full speed after ``starts_s``. Its odometry reports so many times
    what it does.
    """
    wheels, speed, pose = Wheels(FULL), [0.0, 0.0], [0.0, 0.0, 0.0]
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


@pytest.mark.parametrize("order", [AHEAD, LEFT, Velocity(-1.0, 0.0), Velocity(0.3, 0.0), Velocity(1.0, -0.5)])
@pytest.mark.parametrize(("report", "most_s"), [(0.0, 1.1), (-1.0, 1.1)])
def test_wheels_contradict_when_odometry_lies(order: Velocity, report: float, most_s: float) -> None:
    found = compare([order] * 40, report)
    assert found is not None
    share = max(map(abs, order))
    assert found[0] * share <= most_s
    assert "does not follow the commands" in found[1]


@pytest.mark.parametrize("starts_s", [0.0, 0.25, 1.0, STARTS_S / 0.8])
@pytest.mark.parametrize("report", [0.7, 1.0, 1.3])
def test_wheels_agree_when_a_base_is_slow(starts_s: float, report: float) -> None:
    orders = [AHEAD] * 20 + [STANDING] * 10 + [LEFT] * 20 + [Velocity(-0.5, 0.0)] * 20
    assert compare(orders, report, delay_s=DELAY_S, starts_s=max(starts_s, STEP_S)) is None


@given(
    st.lists(
        st.tuples(st.sampled_from([-1.0, 0.0, 0.2, 1.0]), st.sampled_from([-1.0, 0.0, 0.5]), st.integers(1, 8)),
        min_size=1, max_size=12,
    )
)  # fmt: skip
def test_wheels_agree_whatever_is_asked(asked: list[tuple[float, float, int]]) -> None:
    orders = [Velocity(linear, angular) for linear, angular, ticks in asked for _ in range(ticks)]
    assert compare(orders, 1.0) is None
