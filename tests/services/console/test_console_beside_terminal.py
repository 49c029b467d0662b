"""A page beside a terminal: the operator that took over keeps the robot."""

import math
from collections.abc import Callable, Iterator

import pytest

from schemas.base import KEYS
from services.kit.node import Node
from services.kit.settings import ServiceSettings
from services.operator.operator import POLL_S, Operator
from services.recorder.service import RecorderService
from tests.services.console.page import Page
from tests.services.operator.test_operator import RUN, misses_nobody
from tests.services.robot.wheels import Robot

HELD = "permission denied: only the operator (at teleop) may do that"
pytestmark = pytest.mark.parametrize("robot", [False], indirect=True, ids=["unattended"])


@pytest.fixture
def terminal(robot: Robot, settings: ServiceSettings) -> Iterator[Node]:
    """Give the process of somebody at a terminal; they are there while the test waits by its ``spin``."""
    with Node("teleop", settings) as node:
        yield node


def test_page_keeps_the_takeover_of_a_terminal(
    terminal: Node,
    robot: Robot,
    recorder: RecorderService,
    open_page: Callable[[], Page],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(robot.gate, "watch", misses_nobody)
    operator = Operator(terminal, (told := []).append)
    terminal.every(POLL_S, operator.poll)
    assert terminal.spin(lambda: operator.commands.to_release is not None, 30.0)
    assert operator.begin(RUN)
    assert terminal.spin(
        lambda: operator.mine is not None and operator.commands.applied is not None, 30.0
    ), told
    run = operator.mine
    operator.hold(KEYS["left"], math.inf)
    assert terminal.spin(lambda: robot.gate.taken_over and robot.wheels.driven, 30.0)
    operator.hold(None)
    page = open_page()
    page.take()
    assert terminal.spin(
        lambda: page.beats > 0 and page.robot(answers=True, reason="taken_over"), 30.0
    )
    page.say(do="drive", goal="victim")
    assert terminal.spin(lambda: HELD in page.news(), 30.0), page.news()
    assert robot.gate.taken_over
    assert page.state["robot"]["episode"] == run
    assert terminal.spin(lambda: not robot.wheels.driven, 30.0)
    assert robot.gate.operator == terminal.session
    # Who has taken over says when the policy goes on.
    operator.resume()
    assert terminal.spin(lambda: not robot.gate.taken_over, 30.0), told
