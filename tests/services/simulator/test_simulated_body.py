"""The simulated robot as a body: its world follows the clock."""

import math
from pathlib import Path

import numpy as np
import pytest

from schemas.base import KEYS, Message, Velocity
from schemas.rpc import ResetRequest
from services.kit.node import ServiceError
from services.robot.loop import PERIOD_S
from services.simulator.base import KinematicBase
from services.simulator.body import WATCHDOG_S, SimulatedBody
from services.simulator.plan import plan_of
from services.simulator.robots import DriveTrain
from services.simulator.sensors.camera import FOCAL, depth_message
from services.simulator.sensors.depth import measured
from services.simulator.simulation import Simulation
from services.simulator.world import load_world
from services.simulator.world.route import plan_route
from services.simulator.worlds import SimulatorSettings, Worlds
from smal.obstacles.clearance import Mount
from tests.services.robot.line import Clock
from tests.services.simulator.simulator_driving import StubCamera

YARD = load_world("yard")
PERFECT = DriveTrain(tick_sigma=0.0, radius_sigma=0.0)
HEADER = Message(robot="r", episode="e", tick=0, stamp_ns=0)


def body_of(clock: Clock, mode: str = "realtime", **request: object) -> SimulatedBody:
    body = SimulatedBody(Simulation(YARD, StubCamera(), KinematicBase(YARD.place, PERFECT)), clock)
    body.begin(ResetRequest.model_validate({"seed": 1, "purpose": "run", "mode": mode} | request))
    return body


def way_m(body: SimulatedBody, start: tuple[float, float]) -> float:
    pose = body.look(1).pose
    return math.hypot(pose.x - start[0], pose.y - start[1])


def start_of(body: SimulatedBody) -> tuple[float, float]:
    pose = body.look(0).pose
    return pose.x, pose.y


def test_it_goes_on_by_the_clock_until_it_is_told_otherwise() -> None:
    clock = Clock()
    body = body_of(clock)
    start = start_of(body)
    for _ in range(10):
        body.drive(Velocity(0.5, 0.0))
        clock.now_s += PERIOD_S
    body.stand()
    assert way_m(body, start) == pytest.approx(10 * PERIOD_S * 0.5 * PERFECT.speed_m_s)
    clock.now_s += 5.0
    body.stand()
    assert way_m(body, start) == pytest.approx(10 * PERIOD_S * 0.5 * PERFECT.speed_m_s)


@pytest.mark.parametrize("frozen_s", [0.1, 0.5, 14.0, 1e9])
def test_frozen_process_finds_the_robot_stopped_by_its_watchdog(frozen_s: float) -> None:
    clock = Clock()
    body = body_of(clock)
    start = start_of(body)
    body.drive(KEYS["forward"])
    clock.now_s += frozen_s
    body.drive(KEYS["forward"])
    moved_s = min(frozen_s, WATCHDOG_S)
    assert way_m(body, start) == pytest.approx(moved_s * PERFECT.speed_m_s)


def test_in_lockstep_no_clock_moves_it() -> None:
    clock = Clock()
    body = body_of(clock, "lockstep")
    start = start_of(body)
    for _ in range(10):
        body.drive(KEYS["forward"])
        clock.now_s += PERIOD_S
    assert way_m(body, start) == 0.0
    body.advance(KEYS["forward"], 0.1)
    assert way_m(body, start) == pytest.approx(0.1 * PERFECT.speed_m_s)


def test_body_starts_as_asked_and_is_kidnapped_on_request() -> None:
    plain, turned, anywhere, carried = (
        body_of(Clock(), "lockstep", **request)
        for request in ({}, {"start": "turned"}, {"start": "anywhere"}, {"kidnap_tick": 2})
    )
    assert start_of(turned) == start_of(plain)
    facing, back = (body.look(0).pose.heading for body in (plain, turned))
    assert abs(math.remainder(back - facing, math.tau)) == pytest.approx(math.pi)
    assert start_of(plain) == start_of(carried) != start_of(anywhere)
    assert way_m(carried, start_of(plain)) == 0.0
    before = start_of(carried)
    moved = carried.look(2).pose
    assert math.hypot(moved.x - before[0], moved.y - before[1]) > 1.0
    assert carried.look(3).pose == moved, "once"


def test_robot_is_carried_only_to_free_places() -> None:
    body = body_of(Clock(), "lockstep")
    body.advance(KEYS["forward"], 0.5)
    wheels = body.look(1).odometry
    victim = YARD.victim
    x, y = plan_route(YARD, start_of(body))[-2]
    body.carry(float(x), float(y), 1.5)
    assert body.pose == (float(x), float(y), 1.5)
    assert body.look(2).odometry[:3] == wheels[:3]
    wall = YARD.place.solids[0].shape.representative_point()
    for there, why in (
        ((wall.x, wall.y), "no room for the robot"),
        ((1e4, 0.0), "outside of yard"),
    ):
        with pytest.raises(ServiceError, match=why):
            body.carry(*there, 0.0)
    assert body.pose == (float(x), float(y), 1.5), "it stays where it was"
    here = body.begin(ResetRequest(seed=2, start="here"))
    assert body.pose == (float(x), float(y), 1.5)
    assert here.route[0] == (float(x), float(y))
    assert here.route[-1] == (victim.x, victim.y)


def test_task_is_chosen_only_along_a_free_way(tmp_path: Path) -> None:
    worlds = Worlds(SimulatorSettings(world="yard", root=tmp_path))
    simulation = Simulation(YARD, StubCamera(), KinematicBase(YARD.place, PERFECT))
    body = SimulatedBody(simulation, Clock(), worlds=worlds)
    taught = plan_of(simulation.world)
    route = plan_route(YARD, (YARD.start.x, YARD.start.y))
    wall = YARD.place.solids[0].shape.representative_point()
    there, back = (tuple(map(float, route[k])) for k in (-2, 0))
    for goal, why in (
        ((wall.x, wall.y), "no room for the robot"),
        ((there[0] + 0.5, there[1]), "too close"),
        ((1e4, 0.0), "outside of yard"),
    ):
        with pytest.raises(ServiceError, match=why):
            body.choose_task(there, goal)
    off_lanes = (-18.0, -18.0)  # the route from there leads over a lane, also to the same place
    with pytest.raises(ServiceError, match="too close"):
        body.choose_task(off_lanes, off_lanes)
    assert plan_of(simulation.world) == taught, "the world stays as it was"
    assert taught.route[-1] == pytest.approx((YARD.victim.x, YARD.victim.y), abs=0.1)
    body.choose_task(there, back)
    assert simulation.name == "yard", "the same world, for models as well"
    begun = body.begin(ResetRequest(seed=1))
    assert begun.victim == begun.route[-1] == back
    assert math.dist(body.pose[:2], there) < 1.5
    chosen = plan_of(simulation.world)
    assert (chosen.start, chosen.victim) == (there, back)
    assert (
        body.detail()["task"]
        != SimulatedBody(Simulation(YARD, StubCamera()), worlds=worlds).detail()["task"]
    )
    # Another variation of the world keeps the task.
    assert worlds.tasks["yard"][1] == simulation.world.victim


def test_depth_is_told_in_millimetres_with_how_its_camera_sits() -> None:
    mount = Mount(0.65, 1.0, 0.35, 0.4, 1.0)
    told = depth_message(HEADER, np.array([[0.0, 65.0, 1.2345]], dtype=np.float32), mount)
    assert told.to_numpy().tolist() == [[0, 65000, 1234]]
    assert Mount(**told.mounting.model_dump()) == mount


def test_depth_errs_more_far_away_and_has_holes_at_edges() -> None:
    wall = np.full((768, 1024), 4.0, dtype=np.float32)
    wall[:, :200] = np.inf
    wall[200:500, 500:600] = 0.5
    told = measured(wall, FOCAL)
    assert told.shape == (192, 256)
    near = told[60:110, 127:147]
    far = told[:, 60:110]
    assert not told[:, :49].any()  # out of range
    for part, true_m, share in ((near[near > 0], 0.5, 0.003), (far[far > 0], 4.0, 0.03)):
        assert abs(part.mean() - true_m) < 0.01 * true_m
        assert 0.1 * share < part.std() / true_m < share
    assert (told[60:110, 110:124] == 0).mean() > 0.9  # what only one eye sees
    assert (told == measured(wall, FOCAL)).all()
    # What is told fits into the 16 bits of its message, however far it errs.
    assert measured(np.full((240, 320), 64.9, dtype=np.float32), FOCAL).max() <= 65.0
