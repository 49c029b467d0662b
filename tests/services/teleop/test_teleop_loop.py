"""The real teleoperation drives the real actuator, whose body is a point on a line."""

import time
from collections.abc import Callable, Iterator

import pytest

from services.kit.settings import ServiceSettings
from services.robot.loop import STAND_WITHIN_S
from tests.services.conftest import RunNode
from tests.services.robot.wheels import Robot, run_robot
from tests.services.teleop.console import Console
from tests.services.waiting import eventually

# Teleoperation is a process here.
pytestmark = pytest.mark.zenoh


@pytest.fixture
def robot(settings: ServiceSettings, run_node: RunNode) -> Robot:
    return run_robot(settings, run_node, attended=True)


@pytest.fixture
def open_console(router_endpoint: str) -> Iterator[Callable[[], Console]]:
    """Sit down at a terminal that tells releases; a key is held until it is let go, or for 2 s."""
    consoles: list[Console] = []

    def sit_down() -> Console:
        console = Console(router_endpoint, "--first-hold-s", "2")
        consoles.append(console)
        console.tell_releases()
        return console

    yield sit_down
    for console in consoles:
        console.close()


def drive(console: Console, robot: Robot) -> None:
    eventually(lambda: (console.type(b"\x1b[119u"), robot.wheels.driven)[1])


def driving(open_console: Callable[[], Console], robot: Robot) -> Console:
    """Sit down, begin an episode, and drive."""
    console = open_console()
    console.wait_for(r"robot: not armed  \|")
    console.type(b"n")
    console.wait_for(r"robot: stop \(no driver\)")
    drive(console, robot)
    return console


def test_kill_9_of_the_teleoperation_while_it_drives(
    robot: Robot, open_console: Callable[[], Console], lost_s: Callable[[float], float]
) -> None:
    console = driving(open_console, robot)
    console.process.kill()
    killed_s = time.monotonic()
    eventually(lambda: robot.gate.stop_cause == "operator_lost")
    eventually(lambda: not robot.wheels.driven)
    stood_s = robot.wheels.stands_s
    assert stood_s - killed_s <= STAND_WITHIN_S + lost_s(killed_s)
    # Who sits down again is told, and goes on when they say so; no sooner.
    again = open_console()
    again.wait_for(r"robot: stop \(operator lost; r resumes\)")
    again.type(b"\x1b[119u\x1b[119;1:3u")
    again.press_until(b"r", r"robot: stop \(no driver\)", unless=r"no operator answers in time")
    assert robot.wheels.stands_s == stood_s, "the key that was pressed before moved nothing"
    drive(again, robot)
