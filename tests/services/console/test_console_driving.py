"""A page drives the real actuator; the robot stands in time when the page fails or a world opens."""

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
from websockets.exceptions import ConnectionClosed

from schemas.base import KEYS
from schemas.rpc import RecordRequest, ResetRequest
from services.console.web import NONSENSE, TAKEN
from services.console.who_drives import LET_GO_S
from services.kit.jpeg import decode_jpeg
from services.kit.node import Node
from services.kit.settings import ServiceSettings
from services.recorder.service import RecorderService
from services.recordings.reader import read_recording
from services.robot.body import Beginning
from services.robot.loop import STAND_WITHIN_S
from tests.services.conftest import RunNode
from tests.services.console.conftest import Console
from tests.services.console.page import Page
from tests.services.robot.wheels import Robot
from tests.services.waiting import eventually

OpenPage = Callable[[], Page]
Lost = Callable[[float], float]
#: Where the test is about something else: a busy machine may have the robot stand for a moment, and no longer.
unattended = pytest.mark.parametrize("robot", [False], indirect=True, ids=["unattended"])


@pytest.fixture
def driving(open_page: OpenPage, robot: Robot, recorder: RecorderService) -> Page:
    """Give a page at which somebody drives."""
    page = open_page()
    page.begin()
    if not robot.gate.attended:
        eventually(lambda: page.ailments().get("robot", "") is None)
    page.held = "forward"
    eventually(lambda: goes(page, robot))
    return page


def goes(page: Page, robot: Robot) -> bool:
    """Whether the robot is driven; where this machine is so busy that the page was missed, it is armed and goes on."""
    if robot.gate.stop_cause is not None:
        held = page.held
        page.let_go()
        page.say(do="resume")
        page.held = held
    return robot.wheels.driven


def test_page_shows_the_camera_before_a_drive(robot: Robot, open_page: OpenPage) -> None:
    page = open_page()
    eventually(lambda: page.pictures)
    robot.wheels.x = 12.0  # somebody carries it
    eventually(lambda: decode_jpeg(page.pictures[-1])[0, 0, 0] == 120)


@unattended
def test_drive_is_begun_driven_recorded_and_ended_by_the_page(
    robot: Robot,
    recorder: RecorderService,
    open_page: OpenPage,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[ResetRequest] = []
    begin = robot.wheels.begin
    monkeypatch.setattr(
        robot.wheels, "begin", lambda request: asked.append(request) or begin(request)
    )
    page = open_page()
    page.begin(goal="dock", name="to-the-dock")
    assert asked[-1].max_ticks is None, "a person ends it"

    def drive(held: object, **shown: object) -> None:
        """Hold something until it has moved the robot from a frame to the next, which is what teaches."""
        page.held = held
        eventually(
            lambda: goes(page, robot) and page.robot(atom="forward", source="teleop", **shown)
        )
        tick = page.state["robot"]["tick"]
        eventually(lambda: goes(page, robot) and page.state["robot"]["tick"] > tick + 1)

    drive("forward", linear=1.0, angular=0.0)
    eventually(lambda: page.robot(driver="teleop", goal="dock", purpose="drive", world="line"))
    eventually(lambda: page.pictures)
    drive((0.75, -0.25), linear=0.75, angular=-0.25)  # as by a stick
    page.held = None
    eventually(lambda: not robot.wheels.driven)
    page.say(do="end", found=True, box=(0.4, 0.5, 0.6, 0.9))
    eventually(lambda: page.robot(outcome="found", result="found", episode=None))
    (recording,) = eventually(lambda: page.state.get("library", {}).get("recordings"))
    assert (recording["outcome"], recording["goal"], recording["useless"]) == ("found", "dock", "")
    assert page.robot(seconds=recording["seconds"]), "by the robot's clock, as in the report"
    assert page.news().endswith(f"Drive to dock: found after {recording['frames']} frames")
    assert recording["name"].startswith("drives/to-the-dock-")
    (recorded,) = read_recording(tmp_path / recording["name"]).episodes
    assert recorded.box == (0.4, 0.5, 0.6, 0.9)
    assert {("forward", KEYS["forward"]), ("forward", (0.75, -0.25))} <= {
        (one.atom, one.velocity) for one in recorded.applied.values()
    }
    status, picture = page.get(f"/thumbnail?of={recording['name']}&k=0")
    assert (status, picture[:2]) == (200, b"\xff\xd8")


@pytest.mark.parametrize("how", ["vanished", "silent"])
def test_a_page_that_is_gone_stands_the_robot(
    driving: Page, robot: Robot, lost_s: Lost, how: str
) -> None:
    gone_s = time.monotonic()
    if how == "vanished":
        driving.vanish()
    else:
        driving.answers = False
    eventually(lambda: not robot.wheels.driven)
    assert robot.wheels.stands_s - gone_s <= STAND_WITHIN_S + lost_s(gone_s)
    eventually(lambda: robot.gate.stop_cause == "operator_lost")


@unattended
def test_new_key_press_resumes_in_simulation(driving: Page, robot: Robot) -> None:
    robot.gate.stop("operator_lost")
    eventually(lambda: driving.robot(cause="operator_lost"))
    beats = driving.beats
    eventually(lambda: driving.beats > beats + 5)
    assert robot.gate.stop_cause == "operator_lost", "the key that is held all the time"
    driving.let_go()
    driving.held = "forward"
    eventually(lambda: robot.wheels.driven)


def test_late_answers_do_not_move_the_robot(driving: Page, robot: Robot) -> None:
    driving.late_s = 1.5 * LET_GO_S
    eventually(lambda: not robot.wheels.driven)
    beats = driving.beats
    eventually(lambda: driving.beats > beats + 5)
    assert not robot.wheels.driven
    assert robot.gate.stop_cause == "operator_lost"
    driving.late_s = 0.0
    beats = driving.beats
    eventually(lambda: driving.beats > beats + 5)
    assert not robot.wheels.driven, "the key that was held all the time moves nothing"
    driving.let_go()
    eventually(lambda: driving.robot(cause="operator_lost"))
    driving.insist(lambda: robot.gate.stop_cause is None, do="resume")
    driving.held = "forward"
    eventually(lambda: goes(driving, robot))


@unattended
def test_page_request_is_refused_when_it_is_old(driving: Page, robot: Robot) -> None:
    asked_at = driving.beat
    episode = driving.state["robot"]["episode"]
    driving.answers = False
    eventually(lambda: robot.gate.stop_cause == "operator_lost")
    driving.answers = True
    driving.held = None
    beats = driving.beats
    eventually(lambda: driving.beats > beats + 5)
    for what in ({"do": "resume"}, {"do": "drive", "goal": "dock"}):
        driving.refusals.clear()
        driving.insist(
            lambda: any("too late" in refusal for refusal in driving.refusals),
            **what,
            beat=asked_at,
        )
    driving.say(do="cancel")
    assert robot.gate.stop_cause == "operator_lost"
    assert driving.state["robot"]["episode"] == episode


@unattended
def test_an_emergency_stop_overtakes_a_flood(
    driving: Page, robot: Robot, console: Console, open_page: OpenPage
) -> None:
    other = open_page()
    eventually(lambda: other.robot(answers=True))
    flooding = True
    most = 0

    def flood() -> None:
        with suppress(ConnectionClosed):
            while flooding:
                driving.say(do="resume")

    flooder = threading.Thread(target=flood, daemon=True)
    flooder.start()
    try:
        deadline = time.monotonic() + 1.0
        while time.monotonic() < deadline:
            most = max(most, console.service._asked.qsize())
            time.sleep(0.001)
        assert most <= 2
        other.stop()
        eventually(lambda: robot.gate.stop_cause == "emergency_stop")
    finally:
        flooding = False
        flooder.join(100.0)


@unattended
def test_one_drives_and_others_watch(driving: Page, robot: Robot, open_page: OpenPage) -> None:
    other = open_page()
    eventually(lambda: other.state.get("taken"))
    other.take()
    eventually(lambda: other.closed == TAKEN)
    assert driving.closed is None
    driving.close()
    eventually(lambda: robot.gate.stop_cause == "operator_lost")

    def seated() -> bool:
        other.take()
        return bool(eventually(lambda: other.beats or other.closed))

    eventually(seated)


def test_robot_does_not_miss_an_operator_that_left(
    driving: Page, robot: Robot, open_page: OpenPage
) -> None:
    driving.held = None
    eventually(lambda: not robot.wheels.driven)
    driving.say(do="leave")
    eventually(lambda: robot.gate.operator is None)
    # This robot moves only while somebody is there; a simulated one would have gone on.
    assert robot.gate.stop_cause == "operator_lost"
    other = open_page()
    other.take()
    eventually(lambda: other.beats)


def test_any_page_stops_the_robot(
    driving: Page, robot: Robot, open_page: OpenPage, lost_s: Lost
) -> None:
    other = open_page()
    eventually(lambda: other.robot(answers=True))
    for who in ("a watcher", "the driver"):
        driving.held = "forward"
        eventually(lambda: goes(driving, robot))
        pressed_s = time.monotonic()
        other.stop() if who == "a watcher" else driving.say(do="stop")
        eventually(lambda: robot.gate.stop_cause == "emergency_stop" and not robot.wheels.driven)
        assert robot.wheels.stands_s - pressed_s <= STAND_WITHIN_S + lost_s(pressed_s)
        eventually(lambda: other.robot(emergency=True, cause="emergency_stop"))
        driving.let_go()
        eventually(lambda: driving.robot(cause="emergency_stop"))
        driving.insist(
            lambda: robot.gate.stop_cause is None and other.robot(emergency=False), do="resume"
        )
    driving.insist(lambda: other.robot(episode=None), do="end", found=True)
    driving.say(do="leave")
    eventually(lambda: robot.gate.operator is None)
    other.stop()  # it needs no episode, and nobody at the wheel
    eventually(lambda: robot.gate.stop_cause == "emergency_stop")


@unattended
def test_page_nonsense_is_refused_and_moves_nothing(
    driving: Page, robot: Robot, caplog: pytest.LogCaptureFixture
) -> None:
    for said in ("nonsense", b"\x00", '{"do": "hold", "beat": 0, "held": [0, 1.1]}'):
        driving.refusals.clear()
        driving._drive.send(said)
        eventually(lambda: driving.refusals)
        eventually(lambda: goes(driving, robot))
        watch = driving.open("watch")
        watch.send(said)
        eventually(lambda watch=watch: _ended(watch) == NONSENSE)
    assert "Traceback" not in caplog.text


def _ended(socket: object) -> int | None:
    try:
        socket.recv(0.1)
    except Exception:  # noqa: BLE001 - it is closed, or nothing has come yet
        return socket.close_code
    return None


@pytest.mark.parametrize("how", ["leaves", "falls silent"])
def test_episode_does_not_begin_when_its_person_has_left(
    robot: Robot,
    console: Console,
    open_page: OpenPage,
    settings: ServiceSettings,
    run_node: RunNode,
    how: str,
) -> None:
    asked = threading.Event()
    goes_on = threading.Event()

    def start(_: RecordRequest) -> None:
        asked.set()
        assert goes_on.wait(100.0)

    slow = Node("recorder", settings)
    slow.serve("start", RecordRequest, start)
    run_node(slow)
    page = open_page()
    other = open_page()
    page.sit()
    page.insist(asked.is_set, do="drive", goal="dock")
    if how == "leaves":
        page.say(do="leave")
    else:
        page.answers = False
    eventually(lambda: not console.service.attended)
    goes_on.set()
    eventually(lambda: "not begun: the person who asked has left" in other.news())
    assert other.state["robot"]["episode"] is None
    assert robot.gate.latched_stop, "it was not armed"


def test_drive_begins_when_its_recorder_starts_later(
    robot: Robot, open_page: OpenPage, settings: ServiceSettings, run_node: RunNode, tmp_path: Path
) -> None:
    page = open_page()
    page.sit()
    page.say(do="drive", goal="dock")
    eventually(lambda: page.robot(waiting=True))
    node = Node("recorder", settings)
    RecorderService(node, tmp_path)
    run_node(node)
    eventually(lambda: page.robot(waiting=False))
    assert page.state["robot"]["episode"], page.news()
    assert robot.gate.latched_stop == 0


Opening = tuple[threading.Event, threading.Event]  # A world is being opened; the robot goes on.


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
