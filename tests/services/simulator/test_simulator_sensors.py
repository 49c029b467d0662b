"""Odometry and inertial unit: true where nothing is wrong with them, and as wrong as they say where something is."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from schemas.base import ATOMS, Atom
from services.robot.body import ImuReading
from services.robot.clock import TICK_S
from services.simulator.base import KinematicBase, Motion
from services.simulator.drive import WheelSpeeds, move
from services.simulator.robots import TURTLEBOT, Drive
from services.simulator.sensors import EncoderSettings, ImuSettings, Sensors, ShakeSettings
from services.simulator.sensors.imu import GRAVITY_M_S2
from services.simulator.sensors.suite import MOST_READINGS
from services.simulator.simulation import Simulation
from services.simulator.world import load_world
from services.simulator.world.place import Pose
from tests.services.simulator.simulator_driving import StubCamera

DRIVE = TURTLEBOT.drive
STEP_S = 0.02
START = Pose(3.0, -2.0, 2.5)
STEADY = ShakeSettings(0.0)
#: So fine that nothing is left of the ticks, and measured without error.
EXACT = EncoderSettings(ticks_per_turn=1e9, radius_sigma=0.0, track_sigma=0.0)
TICKS = EncoderSettings(radius_sigma=0.0, track_sigma=0.0)
SILENT = ImuSettings(0.0, 0.0, 0.0, acceleration_density=0.0, acceleration_walk=0.0, acceleration_bias_m_s2=0.0)
Wheels = list[tuple[float, float]]
wheel_speeds = st.lists(st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)), min_size=1, max_size=60)


def sensors(
    seed: int = 0,
    *,
    encoders: EncoderSettings = EXACT,
    imu: ImuSettings = SILENT,
    shake: ShakeSettings = STEADY,
    drive: Drive = DRIVE,
) -> Sensors:
    made = Sensors(drive, shake, encoders, imu)
    made.begin(START, *(np.random.default_rng([seed, stream]) for stream in range(3)))
    return made


def go(made: Sensors, wheels: Wheels, slices: int = 1) -> list[Pose]:
    """Roll without slipping for one step of each pair of wheel speeds; return the true pose after each."""
    pose, poses = START, []
    for left, right in wheels:
        for _ in range(slices):
            pose = move(pose, WheelSpeeds(left, right), DRIVE.track_m, STEP_S / slices)
            made.feel(Motion(pose, (left * STEP_S / slices, right * STEP_S / slices), collided=False), STEP_S / slices)
        poses.append(pose)
    return poses


def seen_from_start(pose: Pose) -> tuple[float, float, float]:
    """Return a pose in the frame that odometry has: from the start, x ahead."""
    dx, dy = pose.x - START.x, pose.y - START.y
    cos, sin = math.cos(START.heading), math.sin(START.heading)
    return dx * cos + dy * sin, dy * cos - dx * sin, math.remainder(pose.heading - START.heading, math.tau)


# -- odometry ---------------------------------------------------------------------------------------------------------


@given(wheel_speeds)
@settings(max_examples=60, deadline=None)
def test_perfect_wheels_tell_the_true_path(wheels: Wheels) -> None:
    made = sensors()
    x, y, heading = seen_from_start(go(made, wheels)[-1])
    reading = made.odometry()
    assert (reading.x_m, reading.y_m) == (pytest.approx(x, abs=1e-6), pytest.approx(y, abs=1e-6))
    assert math.remainder(reading.heading_rad - heading, math.tau) == pytest.approx(0, abs=1e-6)


@given(wheel_speeds)
@settings(max_examples=60, deadline=None)
def test_ticks_are_never_lost(wheels: Wheels) -> None:
    """What is less than a tick is seen later, so the heading is never more wrong than by a tick of each wheel."""
    made = sensors(encoders=TICKS)
    x, y, heading = seen_from_start(go(made, wheels)[-1])
    reading = made.odometry()
    tick_m = math.tau * DRIVE.wheel_radius_m / TICKS.ticks_per_turn
    assert abs(math.remainder(reading.heading_rad - heading, math.tau)) <= 1.01 * tick_m / DRIVE.track_m
    way_m = sum(abs(left + right) / 2 * STEP_S for left, right in wheels)
    assert math.hypot(reading.x_m - x, reading.y_m - y) <= 2 * tick_m * (1 + way_m / DRIVE.track_m)


def test_ticks_are_there() -> None:
    made = sensors(encoders=EncoderSettings(ticks_per_turn=36, radius_sigma=0.0, track_sigma=0.0))
    tick_m = math.tau * DRIVE.wheel_radius_m / 36
    seen = []
    for _ in range(20):
        go(made, [(0.1, 0.1)])
        seen.append(made.odometry().x_m / tick_m)
    np.testing.assert_allclose(seen, np.floor(np.arange(1, 21) * 0.1 * STEP_S / tick_m), atol=1e-9)
    assert seen[-1] >= 5


def test_drift_is_what_the_errors_of_calibration_make_it() -> None:
    """Straight for d metres, the heading errs by (e_r - e_l) d / track."""
    settings, way_m, count = EncoderSettings(track_sigma=0.0), 1.0, 300
    wheels = [(0.4, 0.4)] * round(way_m / 0.4 / STEP_S)
    ends = []
    for seed in range(count):
        made = sensors(seed, encoders=settings)
        go(made, wheels)
        ends.append(made.odometry().heading_rad)
    expected = math.sqrt(2) * settings.radius_sigma * way_m / DRIVE.track_m
    # The standard deviation of 300 draws is right within 4 %; three of these are asked.
    assert np.std(ends) == pytest.approx(expected, rel=0.13)
    assert abs(np.mean(ends)) < 4 * expected / math.sqrt(count)


def test_a_wrong_track_shows_when_the_robot_turns() -> None:
    turns = [(-0.1, 0.1)] * 100
    true = sum(0.2 * STEP_S / DRIVE.track_m for _ in turns)
    errors = []
    for seed in range(300):
        made = sensors(seed, encoders=EncoderSettings(1e9, radius_sigma=0.0, track_sigma=0.005))
        go(made, turns)
        errors.append(math.remainder(made.odometry().heading_rad - true, math.tau) / true)
    assert np.std(errors) == pytest.approx(0.005, rel=0.13)


def test_slipping_wheels_lead_odometry_astray() -> None:
    made = sensors()
    for _ in range(50):
        made.feel(Motion(START, (0.008, 0.008), collided=True), STEP_S)
    assert made.odometry().x_m == pytest.approx(0.4), "the robot stands at a wall and its wheels spin"


def test_speeds_are_the_means_since_they_were_asked() -> None:
    made = sensors()
    assert made.odometry() == (0, 0, 0, 0, 0)
    go(made, [(0.1, 0.1)] * 5)
    go(made, [(0.3, 0.3)] * 5)
    assert made.odometry().speed_m_s == pytest.approx(0.2, abs=1e-6)
    go(made, [(-0.1, 0.1)] * 5)
    reading = made.odometry()
    assert (reading.speed_m_s, reading.turn_rate_rad_s) == (
        pytest.approx(0, abs=1e-6),
        pytest.approx(0.2 / DRIVE.track_m, abs=1e-5),
    )
    assert made.odometry()[3:] == (0, 0), "no time has passed"


# -- inertial unit ----------------------------------------------------------------------------------------------------


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


def test_a_curve_pulls_towards_its_middle() -> None:
    made = sensors()
    go(made, [(0.3, 0.4)] * 100)
    speed, rate = 0.35, 0.1 / DRIVE.track_m
    steady = accelerometer(made.imu())[1:]
    np.testing.assert_allclose(steady[:, 1], speed * rate, rtol=1e-3)
    np.testing.assert_allclose(steady[:, 0], 0, atol=1e-9)


def test_at_rest_it_feels_gravity() -> None:
    made = sensors(imu=ImuSettings())
    go(made, [(0.0, 0.0)] * MOST_READINGS)
    readings = made.imu()
    np.testing.assert_allclose(accelerometer(readings).mean(axis=0), [0, 0, 9.81], atol=0.1)
    np.testing.assert_allclose(gyro(readings).mean(axis=0), 0, atol=0.005)


def noise(seconds: float, seed: int, imu: ImuSettings) -> NDArray[np.float64]:
    """Return what is read (n, 6) at rest, less gravity."""
    made, found = sensors(seed, imu=imu), []
    for _ in range(round(seconds / (STEP_S * MOST_READINGS))):
        go(made, [(0.0, 0.0)] * MOST_READINGS)
        readings = made.imu()
        found.append(np.hstack([gyro(readings), accelerometer(readings) - [0, 0, GRAVITY_M_S2]]))
    return np.concatenate(found)


def test_white_noise_has_the_density_that_is_stated() -> None:
    """The mean of n readings over T = n dt seconds scatters by density / sqrt(T), which is what a density means."""
    usual = ImuSettings()
    silent = ImuSettings(gyro_walk=0.0, gyro_bias_rad_s=0.0, acceleration_walk=0.0, acceleration_bias_m_s2=0.0)
    read = noise(200.0, 1, silent)
    means = read.reshape(-1, 25, 6).mean(axis=1)
    expected = np.repeat([usual.gyro_density, usual.acceleration_density], 3) / math.sqrt(25 * STEP_S)
    np.testing.assert_allclose(means.std(axis=0), expected, rtol=0.15)
    neighbours = [np.corrcoef(axis[:-1], axis[1:])[0, 1] for axis in read.T]
    np.testing.assert_allclose(neighbours, 0, atol=0.05)


def test_the_bias_walks_as_stated() -> None:
    usual = ImuSettings()
    walking = ImuSettings(gyro_density=0.0, gyro_bias_rad_s=0.0, acceleration_density=0.0, acceleration_bias_m_s2=0.0)
    ends = np.array([noise(10.0, seed, walking)[-1] for seed in range(60)])
    expected = np.repeat([usual.gyro_walk, usual.acceleration_walk], 3) * math.sqrt(10.0)
    # Three axes and 60 episodes are 180 draws: 5.3 % each, three of these are asked.
    assert (ends[:, :3] / expected[:3]).std() == pytest.approx(1.0, abs=0.16)
    assert (ends[:, 3:] / expected[3:]).std() == pytest.approx(1.0, abs=0.16)


def test_each_episode_has_its_own_bias() -> None:
    usual = ImuSettings()
    biased = ImuSettings(gyro_density=0.0, gyro_walk=0.0, acceleration_density=0.0, acceleration_walk=0.0)
    first = np.array([noise(2.0, seed, biased)[0] for seed in range(100)])
    expected = np.repeat([usual.gyro_bias_rad_s, usual.acceleration_bias_m_s2], 3)
    np.testing.assert_allclose(first.std(axis=0), expected, rtol=0.25)


def test_readings_stay_within_the_sensor_s_range() -> None:
    made = sensors(imu=ImuSettings())
    made.feel(Motion(Pose(START.x + 20.0, START.y, START.heading + 3.0), (20.0, 20.0), collided=False), STEP_S)
    (reading,) = made.imu()
    assert max(map(abs, reading.acceleration_m_s2)) == 16 * GRAVITY_M_S2
    assert max(map(abs, reading.angular_velocity_rad_s)) == math.radians(2000)


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


# -- all of them ------------------------------------------------------------------------------------------------------


@given(wheel_speeds, st.integers(0, 100), st.sampled_from([1, 2, 4]))
@settings(max_examples=40, deadline=None)
def test_readings_do_not_depend_on_how_finely_the_robot_is_moved(wheels: Wheels, seed: int, slices: int) -> None:
    usual = {"encoders": EncoderSettings(), "imu": ImuSettings(), "shake": ShakeSettings()}
    whole, sliced = (sensors(seed, **usual) for _ in range(2))  # type: ignore[arg-type]
    go(whole, wheels)
    go(sliced, wheels, slices)
    np.testing.assert_allclose([*whole.tilt, *whole.tilt_rate], [*sliced.tilt, *sliced.tilt_rate], atol=1e-9)
    whole_imu, sliced_imu = whole.imu(), sliced.imu()
    np.testing.assert_allclose(gyro(whole_imu), gyro(sliced_imu), atol=1e-9)
    np.testing.assert_allclose(accelerometer(whole_imu), accelerometer(sliced_imu), atol=1e-8)
    tick_rad = math.tau * DRIVE.wheel_radius_m / 2578.33 / DRIVE.track_m
    difference = whole.odometry().heading_rad - sliced.odometry().heading_rad
    assert math.remainder(difference, math.tau) == pytest.approx(0, abs=1.01 * tick_rad)


def test_readings_that_nobody_takes_do_not_pile_up() -> None:
    made = sensors()
    go(made, [(0.1, 0.1)] * (MOST_READINGS + 50))
    readings = made.imu()
    assert len(readings) == MOST_READINGS
    assert readings[-1].after_s == pytest.approx(STEP_S * (MOST_READINGS + 50))
    assert made.imu() == ()


def simulation(shake: ShakeSettings | None = None) -> Simulation:
    return Simulation(load_world("yard"), StubCamera(), shake=shake)


def episode(robot: Simulation, seed: int, purpose: str, atoms: list[Atom]) -> list[object]:
    robot.reset(seed, purpose)  # type: ignore[arg-type]
    said: list[object] = [robot.pose]
    for atom in atoms:
        robot.advance(atom, 1.0, TICK_S)
        view = robot.look()
        said += [robot.pose, view.odometry, view.imu]
    return said


@given(
    st.integers(0, 1000), st.sampled_from(["drive", "run", "recovery"]), st.lists(st.sampled_from(ATOMS), max_size=9)
)
@settings(max_examples=30, deadline=None)
def test_an_episode_s_readings_repeat_with_its_seed(seed: int, purpose: str, atoms: list[Atom]) -> None:
    robot = simulation(ShakeSettings())
    first = episode(robot, seed, purpose, atoms)
    episode(robot, seed + 1, purpose, ["forward"])
    assert episode(robot, seed, purpose, atoms) == first


def test_the_camera_s_shake_moves_neither_the_robot_nor_the_wheels() -> None:
    atoms: list[Atom] = ["forward", "left", "forward"] * 5
    steady, shaken = (episode(simulation(ShakeSettings(strength)), 5, "run", atoms) for strength in (0.0, 3.0))
    assert steady[0] == shaken[0]
    assert steady[1::3] == shaken[1::3]
    assert steady[2::3] == shaken[2::3]
    assert steady[3::3] != shaken[3::3]


def test_sensors_do_not_change_how_the_robot_starts_and_drives() -> None:
    """Starts and wheel errors of a seed are what they were before there were sensors."""
    robot = simulation()
    start = robot.reset(7, "run")
    base = KinematicBase(robot.world.place)
    base.put(start, np.random.default_rng([7, 1, 1]))
    for _ in range(20):
        robot.advance("forward", 1.0, TICK_S)
        for _ in range(5):
            motion = base.step("forward", 1.0, STEP_S)
    assert robot.pose == motion.pose


@pytest.mark.parametrize("tick", range(1, 4))
def test_a_tick_has_five_inertial_readings(tick: int) -> None:
    robot = simulation()
    robot.reset(1, "run")
    assert robot.look().imu == ()
    for _ in range(tick):
        robot.advance("forward", 1.0, TICK_S)
        readings = robot.look().imu
    expected = TICK_S * (tick - 1) + STEP_S * np.arange(1, 6)
    np.testing.assert_allclose([reading.after_s for reading in readings], expected)
