"""Odometry, inertial unit and shake: true where nothing is wrong with them, and as wrong as they say elsewhere."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from services.robot.body import ImuReading
from services.simulator.base import Motion, WheelSpeeds, move
from services.simulator.camera import blur
from services.simulator.robots import TURTLEBOT
from services.simulator.sensors import (
    GRAVITY_M_S2,
    EncoderSettings,
    ImuSettings,
    Sensors,
    Shake,
    ShakeSettings,
    Step,
    TiltRate,
)
from services.simulator.world.place import Pose

STEP_S = 0.02
START = Pose(3.0, -2.0, 2.5)
STEADY = ShakeSettings(0.0)
#: So fine that nothing is left of the ticks, and measured without error.
EXACT = EncoderSettings(ticks_per_turn=1e9, radius_sigma=0.0, track_sigma=0.0)
SILENT = ImuSettings(density=(0.0, 0.0), walk=(0.0, 0.0), bias=(0.0, 0.0))
Wheels = list[tuple[float, float]]
wheel_speeds = st.lists(st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)), min_size=1, max_size=60)
DRIVE = TURTLEBOT.drive
FOCAL_PX, EXPOSURE_S = 200.0, 0.02


def sensors(imu: ImuSettings = SILENT, shake: ShakeSettings = STEADY) -> Sensors:
    made = Sensors(TURTLEBOT.drive, shake, EXACT, imu)
    made.begin(START, *(np.random.default_rng([0, stream]) for stream in range(3)))
    return made


def go(made: Sensors, wheels: Wheels) -> list[Pose]:
    """Roll without slipping for one step of each pair of wheel speeds; return the true pose after each."""
    pose, poses = START, []
    for left, right in wheels:
        pose = move(pose, WheelSpeeds(left, right), TURTLEBOT.drive.track_m, STEP_S)
        made.feel(Motion(pose, (left * STEP_S, right * STEP_S), collided=False), STEP_S)
        poses.append(pose)
    return poses


def seen_from_start(pose: Pose) -> tuple[float, float, float]:
    """Return a pose in the frame that odometry has: from the start, x ahead."""
    dx, dy = pose.x - START.x, pose.y - START.y
    cos, sin = math.cos(START.heading), math.sin(START.heading)
    return dx * cos + dy * sin, dy * cos - dx * sin, math.remainder(pose.heading - START.heading, math.tau)


@given(wheel_speeds)
@settings(max_examples=60, deadline=None)
def test_perfect_wheels_tell_the_true_path(wheels: Wheels) -> None:
    made = sensors()
    x, y, heading = seen_from_start(go(made, wheels)[-1])
    reading = made.odometry()
    assert (reading.x_m, reading.y_m) == (pytest.approx(x, abs=1e-6), pytest.approx(y, abs=1e-6))
    assert math.remainder(reading.heading_rad - heading, math.tau) == pytest.approx(0, abs=1e-6)


def gyro(readings: tuple[ImuReading, ...]) -> NDArray[np.float64]:
    return np.array([reading.angular_velocity_rad_s for reading in readings])


def accelerometer(readings: tuple[ImuReading, ...]) -> NDArray[np.float64]:
    return np.array([reading.acceleration_m_s2 for reading in readings])


@given(wheel_speeds)
@settings(max_examples=60, deadline=None)
def test_the_integrals_are_the_true_heading_and_velocity(wheels: Wheels) -> None:
    made = sensors()
    poses = [START, *go(made, wheels)]
    readings = made.imu()
    assert [reading.after_s for reading in readings] == pytest.approx(STEP_S * np.arange(1, len(wheels) + 1))
    turned = STEP_S * gyro(readings)[:, 2].sum()
    assert math.remainder(turned - (poses[-1].heading - START.heading), math.tau) == pytest.approx(0, abs=1e-9)
    # Each acceleration is felt in the heading between the two steps that it is the difference of.
    velocity = np.zeros(2)
    for before, (ahead, left, up) in zip(poses[:-1], accelerometer(readings), strict=True):
        cos, sin = math.cos(before.heading), math.sin(before.heading)
        velocity += STEP_S * np.array([ahead * cos - left * sin, ahead * sin + left * cos])
        assert up == GRAVITY_M_S2
    true = np.array([poses[-1].x - poses[-2].x, poses[-1].y - poses[-2].y]) / STEP_S
    np.testing.assert_allclose(velocity, true, atol=1e-9)


def test_a_shaking_camera_shakes_the_unit() -> None:
    """Its gyroscope feels the tilt's rates, and gravity leans the other way than the unit does."""
    made = sensors(shake=ShakeSettings())
    for _ in range(50):
        go(made, [(0.4, 0.4)])
        (reading,) = made.imu()
        rates = reading.angular_velocity_rad_s
        assert rates == pytest.approx(made.tilt_rate, abs=1e-9)
        _, left, up = reading.acceleration_m_s2
        assert math.atan2(left, up) == pytest.approx(made.tilt.roll_rad, abs=0.03)
    steady = sensors()
    go(steady, [(0.4, 0.4)] * 50)
    assert not gyro(steady.imu())[:, :2].any()


def step(speed: float, turning: float = 0.0, duration_s: float = STEP_S) -> Step:
    """Return a step at fractions of the nominal speed and turn rate."""
    after = Pose(speed * DRIVE.speed_m_s * duration_s, 0.0, turning * DRIVE.turn_rate_rad_s * duration_s)
    return Step(Pose(0.0, 0.0, 0.0), after, (0.0, 0.0), duration_s)


def swings(steps: list[Step], seed: int = 0, settings: ShakeSettings | None = None) -> NDArray[np.float64]:
    """Return the tilts and their rates (n, 2, 3) after each step."""
    shake = Shake(settings or ShakeSettings(), DRIVE, np.random.default_rng(seed))
    found = []
    for one in steps:
        shake.step(one)
        found.append((shake.tilt, shake.rate))
    return np.array(found)


def test_at_the_nominal_speed_each_angle_varies_as_set() -> None:
    """Samples are correlated over 0.1 s: 1200 s are about 12,000 independent ones, so 1 % is 1.5 sigma."""
    np.testing.assert_allclose(np.degrees(LONG[100:, 0].std(axis=0)), [1.0, 1.0, 0.5], rtol=0.04)
    np.testing.assert_allclose(LONG[100:, 0].mean(axis=0), 0, atol=math.radians(0.04))


@given(strength=st.floats(0, 10), seed=st.integers(0, 1000), moves=st.lists(st.floats(-1, 1), max_size=20))
@settings(max_examples=50, deadline=None)
def test_strength_is_one_factor_and_a_seed_repeats(strength: float, seed: int, moves: list[float]) -> None:
    steps = [step(move) for move in moves]
    plain = swings(steps, seed)
    np.testing.assert_allclose(swings(steps, seed, ShakeSettings(strength)), strength * plain, atol=1e-12)
    np.testing.assert_array_equal(swings(steps, seed), plain)


# -- blur -------------------------------------------------------------------------------------------------------------


def dot() -> NDArray[np.uint8]:
    """Return a bright square, 5 wide, on black, in the middle of 121x161."""
    image = np.zeros((121, 161, 3), dtype=np.uint8)
    image[58:63, 78:83] = 250
    return image


def spread(image: NDArray[np.uint8]) -> tuple[float, float, float, float, float]:
    """Return mean column and row, and the variances and covariance of columns and rows, weighted by brightness."""
    weight = image.sum(axis=2) / image.sum()
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]]
    x, y = float((weight * columns).sum()), float((weight * rows).sum())
    dx, dy = columns - x, rows - y
    return x, y, float((weight * dx**2).sum()), float((weight * dy**2).sum()), float((weight * dx * dy).sum())


@given(yaw=st.floats(-6, 6), pitch=st.floats(-6, 6))
@settings(max_examples=40, deadline=None)
def test_a_point_becomes_a_line_as_long_as_its_way(yaw: float, pitch: float) -> None:
    """A way of (a, b) pixels, gone evenly, adds the covariance of (a, b) outer (a, b) / 12."""
    a, b = FOCAL_PX * yaw * EXPOSURE_S, -FOCAL_PX * pitch * EXPOSURE_S
    image = dot()
    blurred = blur(image, TiltRate(0.0, pitch, yaw), EXPOSURE_S, FOCAL_PX)
    assert int(blurred.sum()) == pytest.approx(int(image.sum()), rel=0.03), "light is neither made nor lost"
    (x, y, xx, yy, xy), (x0, y0, xx0, yy0, _) = spread(blurred), spread(image)
    assert (x, y) == (pytest.approx(x0, abs=0.2), pytest.approx(y0, abs=0.2))
    tolerance = 1.0 + 0.05 * (a**2 + b**2) / 12
    assert xx - xx0 == pytest.approx(a**2 / 12, abs=tolerance)
    assert yy - yy0 == pytest.approx(b**2 / 12, abs=tolerance)
    assert xy == pytest.approx(a * b / 12, abs=tolerance)


LONG = swings([step(1.0)] * 60_000)
