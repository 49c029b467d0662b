"""One session by hand: what a key means is settled when it is pressed."""

from __future__ import annotations

from collections.abc import Iterator
from typing import cast

import pytest

from services.kit.node import Node
from services.kit.settings import ServiceSettings
from services.operator.report import Report
from services.teleop.config import TeleopSettings
from services.teleop.session import TeleopSession
from services.teleop.status import status_line
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


@pytest.mark.parametrize(
    ("told", "line"),
    [
        ({}, "robot: -  |  you: left  |  no episode; n: begin one"),
        ({"answers": True, "cause": "not_armed"}, "robot: not armed  |"),
        (
            {"answers": True, "emergency": True, "cause": "emergency_stop"},
            "EMERGENCY STOP  |  robot: emergency stop  |",
        ),
        ({"answers": True, "outcome": "found"}, "robot: armed  |  you: left  |  ended: found; n: next episode"),
        ({"waiting": True}, "robot: -  |  you: left  |  waiting for the robot"),
        ({"reason": "command", "source": "policy"}, "frame 12  |  robot: stop (by policy)  |  refused 3  |"),
        ({"reason": "command", "source": "teleop"}, "robot: stop (by hand)"),
        ({"reason": "silence"}, "robot: stop (nobody drives)"),
        ({"reason": "taken_over"}, "robot: stop (you have taken over; r resumes)"),
        ({"reason": "emergency_stop", "cause": "operator_lost"}, "robot: stop (it had lost you; r resumes)"),
        ({"reason": "silence", "at": 3.0}, "NO SIGN OF THE ROBOT for 7 s"),
        ({"reason": "silence", "driver": "teleop"}, "a person drives"),
    ],
)
def test_the_status_line(told: dict[str, object], line: str) -> None:
    episode = {"episode": "e", "tick": 12, "atom": "stop", "refused": 3, "at": 9.5} if "reason" in told else {}
    assert line in status_line(Report(**episode | told), "left", 10.0)
