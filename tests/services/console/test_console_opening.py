"""A world that the robot opens for a page: who has left or cancels meanwhile drives nothing, and a stop is heard."""

import itertools
import threading
import time
from collections.abc import Callable

import pytest

from schemas.rpc import ResetRequest
from services.kit.going_on import each
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
def test_an_episode_ends_at_once_whose_person_has_left_or_cancelled_while_another_world_was_opened(
    recorder: RecorderService, console: Console, open_page: OpenPage, opening: Opening, how: str
) -> None:
    """Its body tells of no steps between which it could end."""
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


def test_an_emergency_stop_while_another_world_is_opened_is_latched_when_it_is(
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


@pytest.fixture
def endless(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """Have the robot open a world of which there is always more, until it is told not to go on."""
    asked = threading.Event()

    def open_world(_: ResetRequest) -> Beginning:
        for _ in each(itertools.count()):
            asked.set()
            time.sleep(0.001)
        raise AssertionError

    monkeypatch.setattr(robot.wheels, "begin", open_world)
    return asked


@unattended
def test_the_opening_of_a_world_is_cancelled_and_the_next_drive_begins(
    robot: Robot,
    recorder: RecorderService,
    open_page: OpenPage,
    endless: threading.Event,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    page = open_page()
    page.sit()
    page.insist(endless.is_set, do="drive", goal="dock")
    eventually(lambda: page.robot(waiting=True))
    page.insist(lambda: page.robot(waiting=False, episode=None), do="withdraw")
    assert (
        "robot reset: cancelled by its requester; the robot is in line, without an episode"
        in page.news()
    )
    page.say(do="withdraw")
    eventually(lambda: "no episode is beginning; nothing to cancel" in page.news())
    monkeypatch.undo()
    page.insist(lambda: page.state["robot"]["episode"] is not None, do="drive", goal="dock")
