"""Kinematics: exact arcs, and errors that are seeded, of the stated size, and independent of the stepping."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.base import ATOMS, Atom
from services.simulator.drive import Actuator, WheelSpeeds, move, wheel_speeds
from services.simulator.robots import Drive
from services.simulator.world.place import Pose

speeds = st.floats(-3, 3)
headings = st.floats(-math.pi, math.pi)


def euler(pose: Pose, wheels: WheelSpeeds, track_m: float, duration_s: float, steps: int = 20_000) -> Pose:
    """Integrate by many straight steps, each along the heading at its middle."""
    forward = (wheels.left + wheels.right) / 2
    turn = (wheels.right - wheels.left) / track_m
    time = (np.arange(steps) + 0.5) * duration_s / steps
    heading = pose.heading + turn * time
    step = forward * duration_s / steps
    return Pose(
        pose.x + step * np.cos(heading).sum(), pose.y + step * np.sin(heading).sum(), pose.heading + turn * duration_s
    )


@given(left=speeds, right=speeds, heading=headings, duration=st.floats(0, 2))
def test_an_arc_is_what_fine_steps_add_up_to(left: float, right: float, heading: float, duration: float) -> None:
    pose, wheels = Pose(1.0, -2.0, heading), WheelSpeeds(left, right)
    exact, fine = move(pose, wheels, 0.6, duration), euler(pose, wheels, 0.6, duration)
    assert math.hypot(exact.x - fine.x, exact.y - fine.y) < 1e-5
    assert abs(math.remainder(exact.heading - fine.heading, math.tau)) < 1e-9
    assert -math.pi <= exact.heading <= math.pi


@given(left=speeds, right=speeds, heading=headings, first=st.floats(0, 1), second=st.floats(0, 1))
def test_two_moves_are_one_long_move(left: float, right: float, heading: float, first: float, second: float) -> None:
    pose, wheels = Pose(0.0, 0.0, heading), WheelSpeeds(left, right)
    twice = move(move(pose, wheels, 0.6, first), wheels, 0.6, second)
    once = move(pose, wheels, 0.6, first + second)
    assert math.hypot(twice.x - once.x, twice.y - once.y) < 1e-9


@given(speed=st.floats(0, 1))
def test_atoms_move_as_they_are_called(speed: float) -> None:
    drive = Drive()
    done = {atom: move(Pose(0, 0, 0), wheel_speeds(atom, drive, speed), drive.track_m, 1.0) for atom in ATOMS}
    assert done["forward"] == Pose(pytest.approx(2.0 * speed), 0.0, 0.0)
    assert done["backward"] == Pose(pytest.approx(-2.0 * speed), 0.0, 0.0)
    assert done["left"].heading == pytest.approx(0.785 * speed)
    assert done["right"].heading == pytest.approx(-0.785 * speed)
    assert (done["left"].x, done["left"].y) == (0, 0), "turning is on the spot"
    assert done["stop"] == Pose(0, 0, 0)


@given(seed=st.integers(0, 2**32 - 1), atoms=st.lists(st.sampled_from(ATOMS), min_size=1, max_size=8))
def test_errors_belong_to_ticks_and_not_to_steps(seed: int, atoms: list[Atom]) -> None:
    coarse, fine = (Actuator(Drive(), np.random.default_rng(seed)) for _ in range(2))
    for atom in atoms:
        whole = coarse.wheels(atom, 1.0, 0.1)
        assert [fine.wheels(atom, 1.0, 0.02) for _ in range(5)] == [whole] * 5


def test_errors_have_the_stated_size() -> None:
    drive = Drive()
    episodes = np.array([
        [actuator.wheels("forward", 1.0, 0.1) for _ in range(200)]
        for actuator in (Actuator(drive, np.random.default_rng(seed)) for seed in range(300))
    ]) / drive.speed_m_s  # fmt: skip
    assert episodes.mean() == pytest.approx(1.0, abs=0.002)
    assert episodes.std(axis=1).mean() == pytest.approx(drive.tick_sigma, rel=0.05)
    assert episodes.mean(axis=1).std() == pytest.approx(drive.radius_sigma, rel=0.1)


def test_a_stopped_robot_stands_still_whatever_its_wheels_are_like() -> None:
    assert Actuator(Drive(), np.random.default_rng(1)).wheels("stop", 1.0, 0.1) == (0.0, 0.0)
