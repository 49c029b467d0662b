"""The simulation without pixels: episodes repeat, walls stop the robot, the victim counts only near and seen."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.base import ATOMS, Atom
from services.simulator.base import KinematicBase
from services.simulator.robots import Drive
from services.simulator.simulation import Simulation
from services.simulator.variation import VARIATIONS
from services.simulator.world import load_world
from services.simulator.world.route import obstacles_of
from tests.services.simulator.simulator_driving import StubCamera, drive_to

YARD = load_world("yard")
PERFECT = Drive(tick_sigma=0.0, radius_sigma=0.0)


@given(
    seed=st.integers(0, 1000),
    purpose=st.sampled_from(["drive", "run", "recovery"]),
    atoms=st.lists(st.sampled_from(ATOMS), max_size=30),
)
@settings(max_examples=20)
def test_the_same_seed_gives_the_same_episode_however_it_is_stepped(seed: int, purpose: str, atoms: list[Atom]) -> None:
    whole, sliced = (Simulation(YARD, StubCamera()) for _ in range(2))
    assert whole.reset(seed, purpose) == sliced.reset(seed, purpose)  # type: ignore[arg-type]
    for atom in atoms:
        whole.advance(atom, 1.0, 0.1)
        for _ in range(5):
            sliced.advance(atom, 1.0, 0.02)
    assert (whole.pose, whole.collided) == (sliced.pose, sliced.collided)
    one, other = whole.look(), sliced.look()
    assert (one.odometry, one.imu) == (other.odometry, other.imu)


@pytest.mark.parametrize("physical", [False, True])
def test_a_robot_that_is_carried_away_does_not_know_it_by_its_wheels(physical: bool) -> None:
    simulation, again = (
        Simulation(YARD, StubCamera(), None if physical else KinematicBase(YARD.place, PERFECT)) for _ in range(2)
    )
    for one in (simulation, again):
        one.reset(5, "run")
        one.advance("forward", 1.0, 0.5)
    before, wheels = simulation.pose, simulation.look().odometry
    carried = simulation.carry_away()
    assert carried == simulation.pose == again.carry_away()
    assert math.hypot(carried.x - before.x, carried.y - before.y) > 1.0
    now = simulation.look().odometry
    assert (now.x_m, now.y_m, now.heading_rad) == (wheels.x_m, wheels.y_m, wheels.heading_rad)
    for one in (simulation, again):
        one.advance("forward", 1.0, 0.2)
    assert simulation.pose == again.pose
    by_wheels = simulation.look().odometry
    moved = math.hypot(by_wheels.x_m - wheels.x_m, by_wheels.y_m - wheels.y_m)
    assert moved == pytest.approx(math.hypot(simulation.pose.x - carried.x, simulation.pose.y - carried.y), abs=0.1)
    assert moved > 0.1
    simulation.reset(5, "run")
    simulation.advance("forward", 1.0, 0.5)
    assert simulation.pose == before, "the next episode is as if nobody had been carried"


@given(seed=st.integers(0, 500), atoms=st.lists(st.sampled_from(ATOMS), min_size=5, max_size=25))
@settings(max_examples=12)
def test_the_robot_never_enters_anything(seed: int, atoms: list[Atom]) -> None:
    simulation = Simulation(YARD, StubCamera())
    simulation.reset(seed, "recovery")
    for atom in atoms:
        simulation.advance(atom, 1.0, 0.4)
        assert obstacles_of(YARD.place).clearance(simulation.pose.x, simulation.pose.y) > YARD.robot.radius_m - 1e-9


def test_the_victim_is_found_only_when_near_and_seen() -> None:
    camera = StubCamera(fraction=0.5)
    simulation = Simulation(YARD, camera)
    simulation.reset(0, "run")
    assert not simulation.look().victim_found
    assert camera.asked == 0, "far away, the image is not searched at all"
    for x, y in simulation.route()[1:]:
        drive_to(simulation, x, y)
    assert simulation.look().victim_found
    camera.fraction = 0.0004
    assert not simulation.look().victim_found


def test_another_exposure_is_seen() -> None:
    fair, dark = (
        Simulation(YARD, StubCamera(), variation=variation).look().image.mean()
        for variation in (VARIATIONS["day"], VARIATIONS["dark"])
    )
    assert dark < 0.7 * fair
