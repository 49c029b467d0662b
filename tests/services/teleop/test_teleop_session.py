"""One session by hand: what a key means is settled when it is pressed."""

from __future__ import annotations

from collections.abc import Iterator
from typing import cast

import pytest

from services.kit.node import Node
from services.kit.settings import ServiceSettings
from services.teleop.config import TeleopSettings
from services.teleop.session import TeleopSession
from services.teleop.terminal import Terminal
from tests.services.conftest import RunNode
from tests.services.teleop.fake_robot import FakeRobot
from tests.services.waiting import eventually


class Desk:
    """A terminal into which the test types, and whose status line it reads."""

    def __init__(self) -> None:
        self.typed = b""
        self.status = ""
        self.said: list[str] = []
        self.tells_releases = False

    def read(self) -> bytes:
        typed, self.typed = self.typed, b""
        return typed

    def say(self, text: str) -> None:
        self.said.append(text)

    def show(self, status: str) -> None:
        self.status = status


@pytest.fixture
def robot(settings: ServiceSettings, run_node: RunNode) -> FakeRobot:
    robot = FakeRobot(settings)
    run_node(robot.node)
    return robot


@pytest.fixture
def node(robot: FakeRobot, settings: ServiceSettings) -> Iterator[Node]:
    with Node("teleop", settings) as node:
        yield node


def test_who_drives_is_told_once_a_minute_how_long_the_recorder_has_room(
    node: Node, robot: FakeRobot, settings: ServiceSettings, run_node: RunNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.teleop.session.DISK_S", 0.05)
    desk = Desk()
    TeleopSession(node, cast("Terminal", desk), TeleopSettings(seed=5))
    assert node.spin(lambda: "robot: not armed" in desk.status, 10.0)
    assert not desk.said, "there is no recorder"
    recorder, told = Node("recorder", settings), {"disk": "the disk has room for 9 minutes more"}
    asked = []
    recorder.detail = lambda: asked.append(1) or dict(told)
    run_node(recorder)
    assert node.spin(lambda: len(asked) > 3, 10.0)
    told["disk"] = "the disk has room for 8 minutes more"
    assert node.spin(lambda: any("8 minutes" in line for line in desk.said), 10.0)
    assert desk.said == [f"RECORDING: the disk has room for {minutes} minutes more" for minutes in (9, 8)]


def test_nothing_is_released_before_the_robot_has_told_what_it_stands_for(node: Node, robot: FakeRobot) -> None:
    desk = Desk()
    session = TeleopSession(node, cast("Terminal", desk), TeleopSettings(seed=5))
    desk.typed = b"en"  # it cannot have told the number of this stop yet
    session.poll()
    assert desk.said[-1] == "the robot has not told yet whether it stands for a stop; press again"
    eventually(lambda: robot.gate.stop_cause == "emergency_stop")
    assert (robot.arms, robot.resets) == ([], [])
