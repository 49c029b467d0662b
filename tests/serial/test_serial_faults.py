"""Harm a driven base without ROS: by its own log its wheels stand in time."""

import json
import math
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from schemas import topics
from schemas.rpc import LookReply, Nothing
from services.robot.loop import STAND_WITHIN_S
from tests.serial.fake_base import now_s
from tests.serial.rig import Driven, FakeBase, Proxy, config_of, driven
from tests.services.real_base import until
from tests.services.waiting import collected

pytestmark = [pytest.mark.zenoh, pytest.mark.system]


@pytest.fixture(scope="module", params=["tcp", "pty"])
def robot(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Driven]:
    """Drive a base over a network, and one over a pseudo-terminal."""
    base = FakeBase(tmp_path_factory.mktemp(request.param), request.param)
    try:
        with driven(base, config_of(base, base.address)) as one:
            yield one
    finally:
        base.close()


@pytest.mark.parametrize("harm", ["freeze", "stall", "deaf"])
def test_base_stands_in_time_when_an_input_fails(
    robot: Driven, lost_s: Callable[[float], float], harm: str
) -> None:
    until(robot.moves)
    time.sleep(0.5)  # A base that has just started does not show in its pictures.
    began_s = now_s()
    robot.base.harm(harm)
    time.sleep(1.5)  # The wheels must stand meanwhile.
    moved_s = robot.base.moved_s(began_s)
    robot.base.harm("")
    assert moved_s <= STAND_WITHIN_S + lost_s(began_s)
    until(robot.moves)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_base_stands_in_time_when_the_service_fails(
    robot: Driven, lost_s: Callable[[float], float], number: signal.Signals
) -> None:
    until(robot.moves)
    began_s = now_s()
    robot.process.send_signal(number)
    time.sleep(1.0)
    moved_s = robot.base.moved_s(began_s)
    if number == signal.SIGKILL:
        robot.process.wait()
        robot.start()
    else:
        robot.process.send_signal(signal.SIGCONT)
    assert moved_s <= STAND_WITHIN_S + lost_s(began_s)
    until(robot.moves)


def test_base_stands_in_time_when_the_driver_is_silent(
    robot: Driven, lost_s: Callable[[float], float]
) -> None:
    until(robot.moves)
    robot.atom = None
    began_s = now_s()
    time.sleep(1.0)
    moved_s = robot.base.moved_s(began_s)
    robot.atom = "left"
    assert moved_s <= STAND_WITHIN_S + lost_s(began_s)


def test_base_drives_on_when_lines_are_lost_and_garbled(robot: Driven) -> None:
    until(robot.moves)
    robot.base.harm("lossy")
    began_s = now_s()
    time.sleep(2.0)
    steps = robot.base.steps(began_s)
    detail = robot.detail
    robot.base.harm("")
    assert sum(bool(step[4]) for step in steps) > 0.8 * len(steps)
    assert detail["latched_stop"] == 0


def test_odometry_follows_the_wheels(robot: Driven) -> None:
    until(robot.moves)
    heard = collected(robot.bus, topics.ODOMETRY)
    until(lambda: heard)
    before = heard[-1].heading_rad
    truly_before = robot.base.steps(0.0)[-1][3]
    until(lambda: robot.base.steps(0.0)[-1][3] > truly_before + 1.0)
    count = len(heard)
    until(lambda: len(heard) > count + 2)
    turned_rad = robot.base.steps(0.0)[-1][3] - truly_before
    difference = heard[-1].heading_rad - before - turned_rad
    assert abs(math.remainder(difference, math.tau)) < 0.3
    assert robot.detail["odometry_leaps"] == 0


def test_no_old_velocity_arrives_when_the_cable_is_back(
    tmp_path: Path, lost_s: Callable[[float], float]
) -> None:
    base = FakeBase(tmp_path, "tcp")
    proxy = Proxy(base.address)
    proxy.latency_s = 0.03
    try:
        with driven(base, config_of(base, f"tcp://127.0.0.1:{proxy.port}")) as robot:
            until(robot.moves)
            began_s = now_s()
            proxy.cut = True
            until(lambda: robot.detail.get("lacks"), pause_s=0.1)
            robot.atom = None
            time.sleep(1.0)
            moved_s = base.moved_s(began_s)
            proxy.cut = False
            back_s = now_s()
            until(lambda: robot.detail.get("lacks") is None, pause_s=0.1)
            assert moved_s <= STAND_WITHIN_S + lost_s(began_s)
            # TCP may deliver the lines that were on their way, and no others.
            turned = [step[0] for step in base.steps(back_s) if step[4] or step[5]]
            assert len(turned) * 0.02 <= 0.1
            robot.atom = "left"
            until(robot.moves)
    finally:
        base.close()


def test_base_drives_without_odometry(tmp_path: Path) -> None:
    base = FakeBase(tmp_path, "tcp")
    try:
        with driven(base, config_of(base, base.address, odometry=None)) as robot:
            heard = collected(robot.bus, topics.ODOMETRY)
            until(lambda: robot.detail.get("lacks", "") is None, pause_s=0.1)
            look = robot.bus.call("robot", "look", Nothing(), LookReply)  # As the page does.
            assert look.picture is not None
            until(robot.moves)
            assert robot.detail["lacks"] is None
            assert not heard
    finally:
        base.close()


def test_log_and_status_name_the_missing_base(tmp_path: Path) -> None:
    base = FakeBase(tmp_path, "tcp")
    try:
        with driven(base, config_of(base, "/dev/ttyUSB77")) as robot:
            until(lambda: robot.detail, pause_s=0.1)
            assert robot.detail["lacks"] == "/dev/ttyUSB77: not found; is it plugged in?"
            log = (tmp_path / "robot.log").read_text()
            assert log.count("/dev/ttyUSB77: not found; is it plugged in?; the robot stands") == 1
            assert json.loads(robot.path.read_text())["watchdog_s"] == 0.2
    finally:
        base.close()
