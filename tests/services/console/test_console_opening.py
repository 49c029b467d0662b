"""A page that leaves, cancels or stops while the robot opens a world."""

import threading
from collections.abc import Callable

import pytest

from schemas.rpc import ResetRequest
from services.recorder.service import RecorderService
from services.robot.body import Beginning
from tests.services.console.conftest import Console
from tests.services.console.page import Page
from tests.services.robot.wheels import Robot
from tests.services.waiting import eventually

OpenPage = Callable[[], Page]
Opening = tuple[threading.Event, threading.Event]  # A world is being opened; the robot goes on.
unattended = pytest.mark.parametrize("robot", [False], indirect=True, ids=["unattended"])


@pytest.fixture
def opening(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> Opening:
    """Have the robot open another world until the test lets it go on."""
    asked = threading.Event()
    goes_on = threading.Event()
    begin = robot.wheels.begin

    def open_world(request: ResetRequest) -> Beginning:
        asked.set()
        assert goes_on.wait(100.0)
        return begin(request)

    monkeypatch.setattr(robot.wheels, "begin", open_world)
    return asked, goes_on


@unattended
@pytest.mark.parametrize("how", ["leave", "withdraw"])
def test_episode_ends_when_its_person_left_while_a_world_opened(
    recorder: RecorderService, console: Console, open_page: OpenPage, opening: Opening, how: str
) -> None:
    asked, goes_on = opening
    page = open_page()
    other = open_page()
    page.sit()
    page.insist(asked.is_set, do="drive", goal="dock")
    if how == "leave":
        page.say(do="leave")
        eventually(lambda: not console.service.attended)
    else:
        page.say(do="withdraw")
        page.let_go()  # what was said before is heard
    goes_on.set()
    eventually(
        lambda: "the person who asked has left" in other.news() or "cancelled" in other.news()
    )
    eventually(lambda: other.robot(episode=None, waiting=False))


def test_emergency_stop_is_latched_while_a_world_opens(
    robot: Robot, recorder: RecorderService, open_page: OpenPage, opening: Opening
) -> None:
    asked, goes_on = opening
    page = open_page()
    other = open_page()
    page.sit()
    page.held = "forward"
    page.insist(asked.is_set, do="drive", goal="dock")
    other.stop()
    eventually(lambda: robot.gate.stop_cause == "emergency_stop")
    goes_on.set()
    eventually(lambda: page.state["robot"]["episode"] is not None)
    assert robot.gate.stop_cause == "emergency_stop"
    assert not robot.wheels.driven
