"""The real teleoperation drives the real actuator, whose body is a point on a line."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from schemas.base import Atom, Message
from schemas.rpc import ResetRequest
from services.kit.node import Node
from services.kit.settings import ServiceSettings
from services.robot.body import Beginning, ImuReading
from services.robot.clock import now_s
from services.robot.gate import CommandGate
from services.robot.loop import STAND_WITHIN_S, check_stopping
from services.robot.runner import EpisodeRunner
from services.robot.service import RobotService
from services.robot.task import OperatorsTask
from tests.services.conftest import RunNode
from tests.services.teleop.console import Console
from tests.services.waiting import eventually

# Teleoperation is a process here.
pytestmark = pytest.mark.zenoh


@dataclass(frozen=True)
class GreyView:
    """A grey picture."""

    captured_s: float
    contact: bool = False
    odometry: None = None
    imu: tuple[ImuReading, ...] = ()

    @property
    def image(self) -> NDArray[np.uint8]:
        return np.full((24, 32, 3), 128, dtype=np.uint8)

    def more(self, _header: Message, _made: Collection[str] = ()) -> Iterator[Message]:
        return iter(())


class Wheels:
    """A body that notes when it was told to move, and when to stand."""

    name, speed_m_s, focal_px = "line", 1.0, None
    watchdog_s, braking_s = 0.2, 0.1

    def __init__(self) -> None:
        self.told: list[tuple[float, Atom]] = []

    def drive(self, atom: Atom, _speed: float) -> None:
        self.told.append((time.monotonic(), atom))

    def stand(self) -> None:
        self.told.append((time.monotonic(), "stop"))

    def begin(self, _request: ResetRequest) -> Beginning:
        return Beginning()

    def look(self, _tick: int) -> GreyView:
        return GreyView(now_s())

    @property
    def moves(self) -> bool:
        return bool(self.told) and self.told[-1][1] != "stop"

    @property
    def stands_s(self) -> float:
        """When it stood, after it was last told to move."""
        last = max(at for at, (_, atom) in enumerate(self.told) if atom != "stop")
        return self.told[last + 1][0] + self.braking_s


@dataclass(frozen=True)
class Robot:
    """A robot that moves only while an operator is there."""

    wheels: Wheels
    gate: CommandGate


@pytest.fixture
def robot(settings: ServiceSettings, run_node: RunNode) -> Robot:
    wheels, gate = Wheels(), CommandGate(attended=True)
    check_stopping(wheels)
    node = Node("robot", settings)
    RobotService(EpisodeRunner(wheels, OperatorsTask(), gate, settings.robot, "s"), node)
    run_node(node)
    return Robot(wheels, gate)


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
    eventually(lambda: (console.type(b"\x1b[119u"), robot.wheels.moves)[1])


def test_kill_9_of_the_teleoperation_while_it_drives(robot: Robot, open_console: Callable[[], Console]) -> None:
    console = open_console()
    console.wait_for(r"robot: not armed  \|")
    console.type(b"n")
    console.wait_for(r"robot: stop \(nobody drives\)")
    drive(console, robot)
    console.process.kill()
    killed_s = time.monotonic()
    eventually(lambda: robot.gate.stop_cause == "operator_lost")
    eventually(lambda: not robot.wheels.moves)
    assert robot.wheels.stands_s - killed_s <= STAND_WITHIN_S
    # Who sits down again is told, and goes on when they say so; no sooner.
    again = open_console()
    again.wait_for(r"robot: stop \(it had lost you; r resumes\)")
    again.type(b"\x1b[119u\x1b[119;1:3ur")
    again.wait_for(r"robot: stop \(nobody drives\)")
    assert robot.wheels.stands_s - killed_s <= STAND_WITHIN_S, "the key that was pressed before moved nothing"
    drive(again, robot)


def test_an_emergency_stop_stands_until_the_next_episode(robot: Robot, open_console: Callable[[], Console]) -> None:
    console = open_console()
    console.wait_for(r"robot: not armed  \|")
    console.type(b"n")
    console.wait_for(r"robot: stop \(nobody drives\)")
    drive(console, robot)
    console.type(b"\x1b[101u")
    pressed_s = time.monotonic()
    console.wait_for(r"EMERGENCY STOP  \|  .*robot: stop \(emergency stop\)")
    assert robot.gate.stop_cause == "emergency_stop"
    assert robot.wheels.stands_s - pressed_s <= STAND_WITHIN_S
    console.type(b"n")
    console.wait_for(r"seed 6\).*\r\n.*robot: stop \(nobody drives\)")
    drive(console, robot)
    console.type(b"q")
    assert console.process.wait(10.0) == 0
    eventually(lambda: robot.gate.stop_cause == "operator_lost")
