"""The scripted expert stays on its route, and answers every frame once, until it has arrived."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import LineString, Point

from schemas.base import TICK_S, Message
from schemas.motion import TruePose
from schemas.rpc import ResetReply
from services.expert.driver import ExpertService, RouteDriver
from services.robot.body import Kinematics
from services.simulator.base import move, wheel_speeds
from services.simulator.robots import RESCUEBOT, DriveTrain
from services.simulator.world.place import Pose as PlanarPose

DRIVE = RESCUEBOT.drive
FOUND_M = 5.0


@st.composite
def routes(draw: st.DrawFn, sharpest_deg: float) -> list[tuple[float, float]]:
    """Draw stretches that are longer than the driver looks ahead, with a corner between each two."""
    heading = draw(st.floats(-math.pi, math.pi))
    points = [(0.0, 0.0)]
    for _ in range(draw(st.integers(1, 5))):
        length = draw(st.floats(5.0, 30.0))
        points.append(
            (points[-1][0] + length * math.cos(heading), points[-1][1] + length * math.sin(heading))
        )
        heading += math.radians(draw(st.floats(-sharpest_deg, sharpest_deg)))
    return points


def follow(route: list[tuple[float, float]], *, car: bool = False) -> list[PlanarPose]:
    """Drive a route with exact wheels from its start, at first turned to its first stretch."""
    driver = RouteDriver(route, DRIVE.speed_m_s, FOUND_M, car=car)
    (x, y), (to_x, to_y) = route[:2]
    poses = [PlanarPose(x, y, math.atan2(to_y - y, to_x - x))]
    # Twice the time that the way alone takes leaves plenty for turning on the spot.
    most = 100 + round(2 * LineString(route).length / (DRIVE.speed_m_s * TICK_S))
    while not driver.arrived(poses[-1].x, poses[-1].y):
        assert len(poses) < most, "the driver does not arrive"
        poses.append(drive_on(driver, poses[-1], DRIVE.car if car else DRIVE))
    return poses


def drive_on(driver: RouteDriver, pose: PlanarPose, drive: DriveTrain = DRIVE) -> PlanarPose:
    wanted = driver.velocity(pose.x, pose.y, pose.heading)
    assert wanted == Kinematics(drive.speed_m_s, drive.turn_rate_rad_s, drive.radius_m).bounded(
        wanted
    )
    return move(pose, wheel_speeds(wanted, drive), drive.track_m, TICK_S)


# Looking 2.5 m ahead cuts corners: by half a metre at bends that follow on each other, most at a right angle.
@pytest.mark.parametrize(
    ("sharpest_deg", "most_m", "car"), [(35.0, 0.6, False), (110.0, 0.9, False), (35.0, 1.0, True)]
)
def test_driver_keeps_to_its_route(sharpest_deg: float, most_m: float, car: bool) -> None:
    @settings(max_examples=15, deadline=None)
    @given(routes(sharpest_deg))
    def check(route: list[tuple[float, float]]) -> None:
        line = LineString(route)
        poses = follow(route, car=car)
        assert max(line.distance(Point(pose.x, pose.y)) for pose in poses) <= most_m
        assert math.dist((poses[-1].x, poses[-1].y), route[-1]) <= FOUND_M / 2

    check()


def test_driver_comes_back_from_beside_the_route() -> None:
    driver = RouteDriver([(0.0, 0.0), (30.0, 0.0)], DRIVE.speed_m_s, FOUND_M)
    pose = PlanarPose(0.0, 3.0, math.pi / 2)
    for _ in range(80):
        pose = drive_on(driver, pose)
    assert abs(pose.y) < 0.5


def frame(
    tick: int, x: float = 0.0, y: float = 0.0, heading: float = 0.0, episode: str = "e"
) -> TruePose:
    """Return the true pose of a frame."""
    cause = Message(robot="rescuebot", episode=episode, tick=tick, stamp_ns=tick)
    return TruePose.after(cause, x_m=x, y_m=y, heading_rad=heading)


def begun(expert: ExpertService, episode: str = "e") -> ExpertService:
    route = ((0.0, 0.0), (10.0, 0.0), (10.0, 10.0))
    expert.begin(
        ResetReply(
            episode=episode, world="w", route=route, speed_m_s=DRIVE.speed_m_s, found_m=FOUND_M
        )
    )
    return expert


def test_expert_answers_each_frame_with_one_command() -> None:
    expert = begun(ExpertService())
    assert expert.handle(frame(0, episode="other")) is None
    first = expert.handle(frame(0))
    second = expert.handle(frame(1, heading=1.0))
    assert (first.tick, first.atom, first.source) == (0, "forward", "expert")
    assert (second.tick, second.atom) == (1, "right")
    assert expert.handle(frame(1, heading=1.0)) == second, "a frame that is sent again"


def test_expert_is_silent_after_arrival() -> None:
    expert = begun(ExpertService())
    for tick, y in enumerate((8.0, 8.0, 0.0)):
        assert expert.handle(frame(tick, 10.0, y)) is None
        assert expert.arrived
    begun(expert, "next")
    assert not expert.arrived
    assert expert.handle(frame(0, episode="next")) is not None
