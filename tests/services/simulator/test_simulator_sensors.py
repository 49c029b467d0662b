"""Odometry, inertial unit and shake: exact without errors, and as wrong as their model otherwise."""

import math
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from services.robot.body import ImuReading
from services.simulator.base import Motion, WheelSpeeds, move
from services.simulator.robots import TURTLEBOT
from services.simulator.sensors import readings as sensing
from services.simulator.sensors.readings import GRAVITY_M_S2, Sensors
from services.simulator.world.place import Pose

STEP_S = 0.02
START = Pose(3.0, -2.0, 2.5)
Wheels = list[tuple[float, float]]
wheel_speeds = st.lists(
    st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)), min_size=1, max_size=60
)


@pytest.fixture(autouse=True, scope="module")
def fine_ticks() -> Iterator[None]:
    """Make the encoders so fine that nothing is left of their ticks."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sensing, "_TICKS_PER_TURN", 1e9)
        yield


def sensors(shake: float = 0.0) -> Sensors:
    """Return sensors that measure nothing wrong."""
    made = Sensors(TURTLEBOT.drive, shake, error=0.0)
    made.begin(START, *(np.random.default_rng([0, stream]) for stream in range(3)))
    return made


def go(made: Sensors, wheels: Wheels) -> list[Pose]:
    """Roll without slipping for one step of each pair of wheel speeds; return the true pose after each."""
    pose = START
    poses = []
    for left, right in wheels:
        pose = move(pose, WheelSpeeds(left, right), TURTLEBOT.drive.track_m, STEP_S)
        made.feel(Motion(pose, (left * STEP_S, right * STEP_S), collided=False), STEP_S)
        poses.append(pose)
    return poses


def seen_from_start(pose: Pose) -> tuple[float, float, float]:
    """Return a pose in the frame that odometry has: from the start, x ahead."""
    dx = pose.x - START.x
    dy = pose.y - START.y
    cos = math.cos(START.heading)
    sin = math.sin(START.heading)
    return (
        dx * cos + dy * sin,
        dy * cos - dx * sin,
        math.remainder(pose.heading - START.heading, math.tau),
    )


@given(wheel_speeds)
@settings(max_examples=60)
def test_perfect_wheels_tell_the_true_path(wheels: Wheels) -> None:
    made = sensors()
    x, y, heading = seen_from_start(go(made, wheels)[-1])
    reading = made.odometer.read()
    assert (reading.x_m, reading.y_m) == (pytest.approx(x, abs=1e-6), pytest.approx(y, abs=1e-6))
    assert math.remainder(reading.heading_rad - heading, math.tau) == pytest.approx(0, abs=1e-6)


def gyro(readings: tuple[ImuReading, ...]) -> NDArray[np.float64]:
    return np.array([reading.angular_velocity_rad_s for reading in readings])


def accelerometer(readings: tuple[ImuReading, ...]) -> NDArray[np.float64]:
    return np.array([reading.acceleration_m_s2 for reading in readings])


@given(wheel_speeds)
@settings(max_examples=60)
def test_the_integrals_are_the_true_heading_and_velocity(wheels: Wheels) -> None:
    made = sensors()
    poses = [START, *go(made, wheels)]
    readings = made.imu()
    assert [reading.after_s for reading in readings] == pytest.approx(
        STEP_S * np.arange(1, len(wheels) + 1)
    )
    turned = STEP_S * gyro(readings)[:, 2].sum()
    assert math.remainder(turned - (poses[-1].heading - START.heading), math.tau) == pytest.approx(
        0, abs=1e-9
    )
    # Each acceleration is felt in the heading between the two steps that it is the difference of.
    velocity = np.zeros(2)
    for before, (ahead, left, up) in zip(poses[:-1], accelerometer(readings), strict=True):
        cos = math.cos(before.heading)
        sin = math.sin(before.heading)
        velocity += STEP_S * np.array([ahead * cos - left * sin, ahead * sin + left * cos])
        assert up == GRAVITY_M_S2
    true = np.array([poses[-1].x - poses[-2].x, poses[-1].y - poses[-2].y]) / STEP_S
    np.testing.assert_allclose(velocity, true, atol=1e-9)


def test_a_shaking_camera_shakes_the_unit() -> None:
    made = sensors(shake=1.0)
    for _ in range(50):
        go(made, [(0.4, 0.4)])
        (reading,) = made.imu()
        rates = reading.angular_velocity_rad_s
        assert rates == pytest.approx(made.shake.rate, abs=1e-9)
        _, left, up = reading.acceleration_m_s2
        assert math.atan2(left, up) == pytest.approx(made.shake.tilt.roll, abs=0.03)
    steady = sensors()
    go(steady, [(0.4, 0.4)] * 50)
    assert not gyro(steady.imu())[:, :2].any()
