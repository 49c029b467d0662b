"""The page in a real browser, without a stack."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest

from schemas.base import Message
from schemas.camera import CompressedImage
from schemas.rpc import PlanReply, PlanShape
from services.console.config import ConsoleSettings
from services.console.live_content import LiveContent
from services.console.newest_content import Board
from services.console.server import WebServer
from services.kit.jpeg import encode_jpeg
from services.operator.operator import Report
from services.robot.body import OdometryReading
from services.robot.messages import odometry_message
from services.simulator.sensors.camera import depth_message
from tests.services.console.conftest import Nobody
from tests.services.recordings import recorded_messages, test_recorder_files
from tests.services.waiting import eventually
from tests.smal.depth_world import MOUNT, depth
from tests.system.console.console_site import act, run_in

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = pytest.mark.system


@pytest.fixture
def board() -> Board:
    return Board()


@pytest.fixture
def page(browser: Browser, nobody: Nobody, board: Board, tmp_path: Path) -> Iterator[Page]:
    """Open the page; a test in which its script fails has failed."""
    server = WebServer(nobody, board, ConsoleSettings(root=tmp_path, console="127.0.0.1:0"))
    errors: list[str] = []
    page = browser.new_page()
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(server.address)
    yield page
    page.close()
    server.close()
    assert errors == []


def tell_robot(board: Board, **told: object) -> None:
    """Have the robot tell of itself."""
    row = {"idle": 0.0, "uptime": 1, "rates": {}, "dropped": 0, "bad": 0, "failed": 0}
    board.put("health", {"services": [{"name": "robot", "ailment": None, "told": told, **row}]})


def tell_models(board: Board, **goals: list[str]) -> None:
    """Have models in the library, the newest first."""
    models = [{"name": name, "goals": known, "useless": ""} for name, known in goals.items()]
    board.put("library", {"folder": "drives", "recordings": [], "models": models})


def choice(page: Page, name: str) -> str:
    return page.input_value(f"#world-form [name={name}]")


def begin(page: Page, nobody: Nobody) -> Any:
    """Begin a drive; return what was asked for."""
    page.click("#steps [data-panel=teach]")
    act(page, "Begin a drive")
    return eventually(lambda: nobody.asked.pop() if nobody.asked else None)


@pytest.mark.parametrize("name", ["map (1)", "<img src=x onerror=alert(1)>"])
def test_page_drives_a_world_when_its_name_is_unusable(
    page: Page, nobody: Nobody, board: Board, name: str
) -> None:
    """As `smal up --world "map (1).osm"` has it."""
    tell_robot(board, world=name, worlds="campus, yard", variation="day", variations="day, dark")
    page.wait_for_selector("#world-form:visible")
    assert choice(page, "world") == name
    assert begin(page, nobody).world is None
    page.select_option("#world-form [name=world]", "yard")
    assert (asked := begin(page, nobody)).world == "yard"
    assert asked.variation is None


def test_of_a_model_of_the_papers_scheme_no_goal_is_chosen(page: Page, board: Board) -> None:
    goal = page.locator("#run-form [name=goal]")
    tell_models(board, plain=[])
    eventually(lambda: page.input_value("#run-form [name=model]") == "plain")
    assert page.inner_text("#run-form [name=model] option") == "plain (the paper's scheme)"
    assert goal.is_disabled()
    tell_models(board, mapped=["dock", "victim"], plain=[])
    eventually(lambda: page.input_value("#run-form [name=model]") == "mapped")
    assert goal.is_enabled()
    assert goal.input_value() == "dock"
    page.select_option("#run-form [name=model]", "plain")
    assert goal.is_disabled()


@pytest.mark.parametrize("scheme", ["filter", "paper"])
def test_a_model_is_learned_for_the_scheme_that_is_chosen(
    page: Page, nobody: Nobody, board: Board, scheme: str
) -> None:
    tell_robot(board, world="yard", worlds="yard", variation="day", variations="day")
    board.put("library", {"folder": "drives", "models": [], "recordings": [recording("a-s-1")]})
    page.wait_for_selector("#recordings input", state="attached")
    page.fill("#learn-form [name=name]", "way")
    if scheme == "paper":
        page.select_option("#learn-form [name=scheme]", scheme)
    page.click("#seat")
    act(page, "Learn")
    ask = eventually(lambda: next((ask for ask in nobody.asked if ask.do == "learn"), None))
    assert (ask.name, ask.scheme, ask.recordings) == ("way", scheme, ("drives/a-s-1.mcap",))


def test_a_model_learns_more_from_the_runs_of_today(
    page: Page, nobody: Nobody, board: Board
) -> None:
    now = {"when_s": time.time(), "purpose": "run"}
    runs = [recording(name) | now for name in ("a", "b")]
    others = [
        recording("before") | {"purpose": "run"},
        recording("timed-out") | now | {"outcome": "timeout"},
    ]
    elsewhere = [
        recording("elsewhere") | now | {"world": "campus"},
        recording("drive") | now | {"purpose": "drive"},
    ]
    models = [{"name": "models/way.smal", "goals": ["victim"], "worlds": ["yard"], "useless": ""}]
    board.put(
        "library",
        {"folder": "drives", "models": models, "recordings": [runs[0], *others, *elsewhere]},
    )
    page.wait_for_selector("#recordings input", state="attached")
    assert page.is_hidden("#learn-today")
    board.put(
        "library",
        {"folder": "drives", "models": models, "recordings": [*runs, *others, *elsewhere]},
    )
    page.click("#steps [data-panel=run]")
    page.wait_for_selector("#learn-today:visible")
    assert page.inner_text("#learn-today") == "Learn from today's 2 runs"
    page.click("#learn-today")
    ask = eventually(lambda: next((ask for ask in nobody.asked if ask.do == "add"), None))
    assert (ask.model, ask.recordings) == ("models/way.smal", ("drives/a.mcap", "drives/b.mcap"))


def recording(name: str) -> dict[str, object]:
    facts = {
        "when_s": 1.0, "size": 1, "purpose": "drive", "goal": "victim", "world": "yard",
        "outcome": "found", "result": "found",
    }  # fmt: skip
    shown = {"frames": 9, "seconds": 1.0, "useless": "", "thumbnails": 0}
    return {"name": f"drives/{name}.mcap", "episode": name, **facts, **shown}


def test_driver_cancels_an_episode_that_is_being_begun(
    page: Page, nobody: Nobody, board: Board
) -> None:
    told = {"episode": None, "answers": True, "emergency": False, "at": 0.0}
    board.put("robot", told | {"waiting": True})
    page.wait_for_selector("#status:has-text('Waiting for the robot')")
    act(page, "Cancel")
    eventually(lambda: [ask.do for ask in nobody.asked] == ["withdraw"])
    board.put("robot", told | {"waiting": False})
    page.wait_for_selector("#actions :text('Cancel')", state="hidden")


def test_step_and_reason_stay_when_a_run_is_refused(page: Page, board: Board) -> None:
    told = {"episode": None, "answers": True, "emergency": False, "at": 0.0}
    board.put("robot", told | {"waiting": False})
    tell_models(board, way=["victim"])
    page.click("#steps [data-panel=run]")
    board.put("robot", told | {"waiting": True})
    page.wait_for_selector("#status:has-text('Waiting for the robot')")
    board.put("news", [{"number": 1, "at": board.clock(), "text": "recorder: no answer"}])
    board.put("robot", told | {"waiting": False})
    page.wait_for_selector("#status:has-text('Recorder: no answer')")

    def latest_is_gone() -> bool:
        board.put("robot", told | {"waiting": False, "at": board.clock()})
        return page.inner_text("#latest") == ""

    eventually(latest_is_gone)
    assert page.inner_text("#status") == "Recorder: no answer"
    assert page.is_visible("#run")
    page.keyboard.press("Tab")
    page.wait_for_selector("#status:has-text('Recorder')", state="hidden")


def test_chosen_step_stays_until_an_episode_begins_or_ends(page: Page, board: Board) -> None:
    between = {"episode": None, "answers": True, "emergency": False, "waiting": False, "at": 0.0}
    board.put("robot", between)
    tell_robot(board, world="yard", worlds="campus, yard")
    tell_models(board, way=["victim"])
    page.wait_for_selector("#run:visible")
    page.click("#steps [data-panel=teach]")
    # A drive that nothing has been learned from arrives in the list.
    library = {"folder": "drives", "models": [], "recordings": [recording("a")]}
    board.put("library", library)
    page.wait_for_selector("#recordings input", state="attached")
    page.wait_for_selector("#steps [data-panel=learn][aria-current]")
    assert page.is_visible("#teach")
    board.put("robot", DRIVE | {"at": board.clock()})
    page.wait_for_selector("#actions :text('Found: end here')")
    ended = {"episode": None, "outcome": "found", "result": "found", "at": board.clock()}
    board.put("robot", DRIVE | ended)
    page.wait_for_selector("#learn:visible")


def test_sentence_stays_when_the_reason_changes_with_each_frame(page: Page) -> None:
    script = """import('./lead.js').then(({Steady}) => {
        const steady = new Steady(), said = (at, text, level = "warn") => steady.show(level, text, "e", at)[1];
        return [said(0, "a"), said(100, "b"), said(200, "a"), said(300, "b"), said(1200, "b"), said(1300, "b"),
            said(1400, "stop", "bad"), said(1500, "b")];
    })"""
    assert run_in(page, script) == ["a", "a", "a", "a", "a", "b", "stop", "b"]


def test_page_draws_course_and_obstacles_over_the_picture(
    page: Page, nobody: Nobody, board: Board
) -> None:
    """A box stands before it on the left; it drives on, in a bend to the right."""
    node = SimpleNamespace(
        subscribe=lambda *_, **__: None, apart=lambda *_: None, bus=None, name="console"
    )
    live = LiveContent(node, board, nobody.library)
    frame = Message(robot="r", episode="e", tick=1, stamp_ns=0)
    measured = depth([(3.0, 0.5, 4.0, 2.0, 1.2)], (0.0, 0.0, 0.0), shape=(240, 320))
    picture = CompressedImage.after(
        frame, width=320, height=240, data=encode_jpeg(np.full((240, 320, 3), 128, "u1"))
    )
    tell_robot(board, world="yard", speed_m_s=2.0, turn_rate_rad_s=0.8)
    told = {
        "episode": "e", "answers": True, "waiting": False, "emergency": False, "linear": 1.0,
        "angular": -0.5,
    }  # fmt: skip

    def drawn(x: int, y: int) -> list[int]:
        board.put("robot", told | {"at": board.clock()})
        live._obstacles.store_odometry(
            odometry_message(frame, OdometryReading(0.0, 0.0, 0.0, 2.0, 0.0))
        )
        live._obstacles.store_depth(depth_message(frame, measured, MOUNT))
        live._on_image(picture)
        script = f"[...document.querySelector('#camera canvas').getContext('2d').getImageData({x}, {y}, 1, 1).data]"
        return run_in(page, script)[:3]

    def is_more(x: int, y: int, channel: int) -> bool:
        pixel = drawn(x, y)
        return pixel[channel] == max(pixel) > 20 + min(pixel)

    eventually(lambda: is_more(90, 140, 0))  # 1 m to the left, at 2.65 m: red
    eventually(lambda: is_more(219, 217, 1))  # 0.6 m to the right, at 2.15 m, on the ground: green
    assert drawn(250, 60) == [128, 128, 128]


def test_map_shows_the_plan_of_the_variation_and_the_scheme(
    page: Page, nobody: Nobody, board: Board
) -> None:
    detail = {"world": "pond", "variation": "day", "worlds": "pond"}
    square = ((0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0), (0.0, 0.0))

    def plan(*_: object) -> PlanReply:
        kind = "water" if detail["variation"] == "day" else "solid"
        # They overlap in opposite directions.
        shapes = [PlanShape(kind=kind, points=one, filled=True) for one in (square, square[::-1])]
        return PlanReply(world="pond", start=(1.0, 1.0), victim=(3.0, 3.0), shapes=tuple(shapes))

    node = SimpleNamespace(
        subscribe=lambda *_, **__: None,
        apart=lambda *_: None,
        bus=SimpleNamespace(call=plan),
        name="console",
    )
    live = LiveContent(node, board, nobody.library)
    live.health.statuses = {"robot": SimpleNamespace(detail=detail)}

    def shows(*colour: int) -> bool:
        live._look_at_world()
        map_canvas = "document.querySelector('#map canvas')"
        middle = f"getImageData({map_canvas}.width / 2, {map_canvas}.height / 2, 1, 1).data"
        return run_in(page, f"[...{map_canvas}.getContext('2d').{middle}]")[:3] == list(colour)

    eventually(lambda: shows(181, 211, 232))
    page.emulate_media(color_scheme="dark")
    eventually(lambda: shows(28, 51, 70))
    detail["variation"] = "moved"
    eventually(lambda: shows(107, 97, 86))


def test_box_goes_with_found_unless_the_robot_moves_on(
    page: Page, nobody: Nobody, board: Board
) -> None:
    def draw(*corners: tuple[float, float]) -> None:
        """Drag over the picture, which is 4 to 3, and shown whole in the middle."""
        at = page.locator("#camera > .picture > canvas").bounding_box()
        scale = min(at["width"] / 4, at["height"] / 3)
        for number, (x, y) in enumerate(corners):
            page.mouse.move(
                at["x"] + at["width"] / 2 + 4 * scale * (x - 0.5),
                at["y"] + at["height"] / 2 + 3 * scale * (y - 0.5),
            )
            if number == 0:
                page.mouse.down()
        page.mouse.up()

    def found() -> tuple[float, ...] | None:
        act(page, "Found: end here")
        eventually(lambda: nobody.asked)
        return nobody.asked.pop().box

    told = {
        "episode": "e",
        "answers": True,
        "waiting": False,
        "emergency": False,
        "at": board.clock(),
        "driver": "teleop",
        "seconds": 9.0,
        "moved": True,
    }
    board.put("robot", told)
    page.click("#seat")
    eventually(lambda: page.get_attribute("#seat", "aria-pressed") == "true")
    draw((0.7, 0.5), (0.4, 0.9))
    assert found() == pytest.approx((0.4, 0.5, 0.7, 0.9), abs=0.01)
    draw((0.4, 0.5), (0.41, 0.51))  # as by a click
    assert found() is None
    draw((0.4, 0.5), (0.7, 0.9))
    page.keyboard.press("w")
    assert found() is None


def test_keys_and_sticks_are_velocities(page: Page, nobody: Nobody) -> None:
    def has(*held: float) -> None:
        eventually(lambda: nobody.held == (pytest.approx(held) if held else None))

    def push(x: float, y: float, connected: str = "true") -> None:
        pad = f"{{connected: {connected}, buttons: [], axes: [{x}, {y}]}}"
        run_in(page, f"navigator.getGamepads = () => [null, {pad}]")

    page.click("#seat")
    eventually(lambda: page.get_attribute("#seat", "aria-pressed") == "true")
    key = page.keyboard
    for does, name, held in (
        (key.down, "w", (1, 0)),
        (key.down, "d", (1, -1)),
        (key.up, "w", (0, -1)),
        (key.up, "d", ()),
    ):
        does(name)
        has(*held)
    # The last one as a worn stick stands.
    for axes, held in ((-0.3, -0.8), (0.8, 0.3)), ((0.1, 0.5), (-0.5, 0)), ((0.1, -0.1), ()):
        push(*axes)
        has(*held)
    push(0, -1)
    has(1, 0)
    push(0, -1, "false")  # its battery is empty
    has()


DRIVE = {
    "episode": "e", "answers": True, "waiting": False, "emergency": False, "purpose": "drive",
    "driver": "teleop", "source": "teleop", "goal": "victim", "seconds": 3.0, "tick": 30,
}  # fmt: skip


def test_found_asks_when_the_robot_has_not_moved(page: Page, nobody: Nobody, board: Board) -> None:
    board.put("robot", DRIVE | {"moved": False, "at": board.clock()})
    act(page, "Found: end here")
    page.wait_for_selector("#next:text('Here? You have not moved')")
    assert nobody.asked == []
    page.click("#next")
    eventually(lambda: [ask.do for ask in nobody.asked] == ["end"])
    ended = {"episode": None, "outcome": "found", "result": "found", "cause": None}
    board.put("robot", DRIVE | ended | {"at": board.clock()})
    page.wait_for_selector("#recordings-empty:text-is('Storing the drive …')")


def test_belief_is_hidden_while_a_person_teaches(page: Page, board: Board) -> None:
    board.put("model", {"name": "m", "trouble": "broken"})
    page.click("#steps [data-panel=run]")
    page.wait_for_selector("#belief:has-text('broken')")
    board.put("robot", DRIVE | {"at": board.clock()})
    page.wait_for_selector("#belief", state="hidden")


def test_dead_robot_is_grey(page: Page, board: Board) -> None:
    board.put("robot", asdict(Report()))
    page.wait_for_selector(".pill.old #status:text-is('The robot does not answer')")
    board.put("robot", DRIVE | {"episode": None, "answers": False, "at": board.clock() - 12.0})
    page.wait_for_selector(".pill.old:has-text('The robot does not answer for 1')")
    assert page.get_attribute("#camera", "class") == "old"


def test_run_has_the_options_that_were_chosen(page: Page, nobody: Nobody, board: Board) -> None:
    tell_robot(board, world="yard", worlds="yard", variation="day", variations="day")
    tell_models(board, way=["victim"])
    page.click("#steps [data-panel=run]")
    page.click("text=Make it harder")
    for name, choice_ in (("victim", "moved"), ("obstacles", "2"), ("people", "5")):
        page.select_option(f"#run-form [name={name}]", choice_)
    page.select_option("#run-form [name=kidnap]", label="after 10 s")
    act(page, "Run")
    run = eventually(lambda: nobody.asked.pop() if nobody.asked else None)
    assert (run.victim, run.obstacles, run.people, run.kidnap_tick) == ("moved", 2, 5, 100)


def show_robot(board: Board) -> None:
    """Have a simulated robot stand in its world, 10 m wide."""
    tell_robot(board, world="yard", worlds="yard", variation="day", variations="day")
    plan = PlanReply(world="yard", start=(0.0, 0.0), victim=(10.0, 0.0), shapes=())
    board.put("ground", plan.model_dump())
    board.put("stands", {"pose": [5.0, 0.0, 0.0], "at": board.clock()})


def test_robot_is_carried_when_a_person_drags_it(page: Page, nobody: Nobody, board: Board) -> None:
    page.set_viewport_size({"width": 1280, "height": 1000})
    show_robot(board)
    page.wait_for_selector("#carry:visible")
    page.click("#enlarge")

    def drag(right: float, up: float) -> Any:
        board.put("stands", {"pose": [5.0, 0.0, 0.0], "at": board.clock()})
        box = page.locator("#carry").bounding_box()
        x = box["x"] + box["width"] / 2
        y = box["y"] + box["height"] / 2
        page.mouse.move(x, y)
        page.mouse.down()
        for share in (0.2, 0.4, 0.6, 0.8, 1.0):
            page.mouse.move(x + share * right, y - share * up)
        page.mouse.up()
        return eventually(lambda: nobody.asked.pop() if nobody.asked else None)

    ahead = drag(100.0, 0.0)
    up = drag(0.0, 100.0)
    # The map shows 10 m between its margins of 18 pixels, and the robot faces where it was pulled.
    metres = 100.0 * 10.0 / (page.locator("#map canvas").bounding_box()["width"] - 36.0)
    assert (ahead.x_m, ahead.y_m, ahead.heading_rad) == pytest.approx(
        (5.0 + metres, 0.0, 0.0), abs=0.05
    )
    assert (up.x_m, up.y_m, up.heading_rad) == pytest.approx((5.0, metres, 1.5), abs=0.15)
    page.click("#steps [data-panel=run]")
    assert page.input_value("#run-form [name=start]") == "here"
    board.put("robot", DRIVE | {"at": board.clock()})
    page.wait_for_selector(
        "#carry", state="hidden"
    )  # not in a drive, which would teach a wrong way


def test_robot_is_carried_by_keys_unless_escape_is_pressed(
    page: Page, nobody: Nobody, board: Board
) -> None:
    show_robot(board)
    page.wait_for_selector("#carry:visible")
    page.focus("#carry")
    for last in ("Escape", "Enter"):
        page.keyboard.press("Enter")
        page.wait_for_selector("#map-state:has-text('Escape cancels')")
        for _ in range(10):
            page.keyboard.press("ArrowRight")
        page.keyboard.press(last)
        page.wait_for_selector("#map-state", state="hidden")
    (asked,) = eventually(lambda: nobody.asked)
    assert asked.do == "carry"
    assert asked.x_m > 5.5
    assert nobody.stops == 0
    page.keyboard.press("Escape")
    eventually(lambda: nobody.stops)


@pytest.mark.parametrize("by", ["mouse", "keys"])
def test_start_and_goal_are_chosen_on_the_map(
    page: Page, nobody: Nobody, board: Board, by: str
) -> None:
    show_robot(board)
    page.click("#steps [data-panel=teach]")
    page.click("#choose")
    page.wait_for_selector("#map-state:has-text('Click the start')")
    box = page.locator("#map canvas").bounding_box()
    middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    for k in (-1, 1):
        if by == "mouse":
            page.mouse.click(middle[0] + 60 * k, middle[1])
        else:
            for _ in range(15 + 5 * k):
                page.keyboard.press("ArrowRight" if k > 0 else "ArrowLeft")
            page.keyboard.press("Enter")
        if k < 0:
            page.wait_for_selector("#map-state:has-text('Click the goal')")
    (asked,) = eventually(lambda: nobody.asked)
    assert asked.do == "task"
    assert asked.start[0] < 5.0 < asked.goal[0]
    assert asked.start[1] == pytest.approx(asked.goal[1])
    page.wait_for_selector("#map-state", state="hidden")
    page.click("#choose")
    page.keyboard.press("Escape")
    page.wait_for_selector("#map-state", state="hidden")
    assert nobody.stops == 0
    board.put("robot", DRIVE | {"at": board.clock()})
    page.wait_for_selector("#choose[disabled]", state="attached")


def test_files_are_renamed_and_deleted(page: Page, nobody: Nobody, board: Board) -> None:
    tell_models(board, **{"models/way.smal": ["victim"]})
    page.click("#steps [data-panel=run]")
    page.click("#models summary")
    page.click("#models [data-does=rename]")
    page.fill("#models [name=label]", "dock")
    page.click("#models [data-does=rename]")
    ask = eventually(lambda: nobody.asked.pop() if nobody.asked else None)
    assert (ask.do, ask.file, ask.name) == ("rename", "models/way.smal", "dock")
    page.click("#models [data-does=delete]")
    assert nobody.asked == []
    page.click("#models [data-does=delete]")
    eventually(lambda: [ask.do for ask in nobody.asked] == ["delete"])


SMALL = """[...document.querySelectorAll("a, button, select, input, summary, .file")]
    .filter((one) => one.checkVisibility() && !one.closest(".file input, .files label"))
    .map((one) => [one.outerHTML.slice(0, 80), one.getBoundingClientRect()])
    .filter(([, {width, height}]) => width > 0 && (width < 44 || height < 44)).map(([html]) => html)"""


def test_phone_keeps_pad_and_stop_in_reach(page: Page, board: Board) -> None:
    tell_robot(board, world="yard", worlds="yard", variation="day", variations="day")
    page.set_viewport_size({"width": 390, "height": 844})
    for panel in ("teach", "learn", "run", "more"):
        page.click(f"#steps [data-panel={panel}]")
        assert run_in(page, "document.documentElement.scrollWidth") == 390
        assert run_in(page, SMALL) == []
        run_in(page, "scrollTo(0, document.body.scrollHeight)")
        for part in ("#pad", "#stop"):
            box = page.locator(part).bounding_box()
            assert box["y"] > 0
            assert box["y"] + box["height"] <= 844


OVERLAP = """(() => {{
    const [one, other] = ["{}", "{}"].map((name) => document.querySelector(name).getBoundingClientRect());
    const sides = [["left", "right"], ["top", "bottom"]].map(([low, high]) =>
        Math.max(0, Math.min(one[high], other[high]) - Math.max(one[low], other[low])));
    return sides[0] * sides[1];
}})()"""


@pytest.mark.parametrize("size", [(1440, 900), (1024, 768), (390, 844)])
def test_map_is_whole_beside_pad_and_buttons(
    page: Page, board: Board, size: tuple[int, int]
) -> None:
    show_robot(board)
    page.set_viewport_size({"width": size[0], "height": size[1]})
    page.wait_for_selector("#carry:visible")
    assert run_in(page, OVERLAP.format("#map canvas", "#enlarge")) == 0
    page.click("#enlarge")
    assert run_in(page, OVERLAP.format("#map canvas", "#pad")) == 0


@pytest.mark.parametrize("size", [(1440, 900), (1024, 768), (768, 1024), (390, 844)])
def test_next_step_is_seen_without_scrolling(
    page: Page, board: Board, size: tuple[int, int]
) -> None:
    board.put("robot", DRIVE | {"episode": None, "at": board.clock()})
    page.set_viewport_size({"width": size[0], "height": size[1]})
    board.put("taken", content=True)
    page.wait_for_selector("#seat:text('Another person drives')")
    page.wait_for_selector("#next:text('Begin a drive')")
    assert run_in(page, OVERLAP.format("#seat", "#steps button:last-child")) == 0
    assert run_in(page, "document.documentElement.scrollWidth") == size[0]
    board.put("robot_id", "rescuebot")
    page.wait_for_selector("h1:has-text('rescuebot')")
    name = (
        "(({scrollWidth, clientWidth}) => scrollWidth - clientWidth)(document.querySelector('h1'))"
    )
    assert run_in(page, name) == 0
    for part in ("#next", "#stop", "#pad", ".pill", "#camera > .picture"):
        box = page.locator(part).bounding_box()
        assert 0 <= box["y"] <= size[1] - box["height"], part


def test_page_warns_when_the_model_is_of_another_world(page: Page, board: Board) -> None:
    tell_robot(board, world="yard", worlds="campus, yard", variation="day", variations="day")
    models = [
        {"name": f"models/{world}.smal", "goals": ["victim"], "worlds": [world], "useless": ""}
        for world in ("campus", "yard")
    ]
    board.put("library", {"folder": "drives", "recordings": [], "models": models})
    page.click("#steps [data-panel=run]")
    eventually(lambda: page.input_value("#run-form [name=model]") == "models/yard.smal")
    assert page.inner_text("#elsewhere") == ""
    page.select_option("#run-form [name=model]", "models/campus.smal")
    assert page.inner_text("#elsewhere").startswith("campus was taught in campus")


RUN = DRIVE | {"purpose": "run", "driver": "policy", "source": "policy"}
GREY = "document.querySelector('{} canvas').getContext('2d').getImageData(9, 9, 1, 1).data[0]"


def run_and_find(page: Page, board: Board, moments: int = 8) -> None:
    """Show a run of one metre and half a second a moment; the camera turns from dark to white."""
    place = {"episode": "run-1", "pose": [0.0, 0.0, 0.0]}
    board.put("goal", {"episode": "run-1", "at": [float(moments), 0.0], "boxes": []})
    for k in range(moments):
        now = {"at": board.clock()}
        board.put("robot", RUN | now | {"episode": "run-1", "seconds": k / 2})
        board.put("pose", place | now | {"pose": [float(k), 0.0, 0.0]})
        board.put("driven", {"episode": "run-1", "metres": float(k)})
        eventually(lambda s=k / 2: page.inner_text("#facts") == f"{s:.1f} s")
        grey = 35 + 220 * k // (moments - 1)  # An empty canvas is black.
        board.show(encode_jpeg(np.full((48, 64, 3), grey, np.uint8)))
        eventually(lambda grey=grey: abs(run_in(page, GREY.format("#camera")) - grey) < 4)
    ended = {"episode": None, "outcome": "found", "result": "found", "seconds": moments / 2}
    board.put("robot", RUN | ended | {"at": board.clock()})
    page.wait_for_selector("#finish:visible")


COVERED = """(() => {
    const news = document.querySelector("#latest").getBoundingClientRect();
    return [...document.querySelectorAll("a, button, select, input, summary")]
        .filter((one) => one.checkVisibility())
        .map((one) => [one.outerHTML.slice(0, 80), one.getBoundingClientRect()])
        .filter(([, { left, right, top, bottom }]) =>
            left < news.right && right > news.left && top < news.bottom && bottom > news.top)
        .map(([html]) => html);
})()"""


def test_finish_shows_the_run_when_it_has_ended(page: Page, board: Board) -> None:
    run_and_find(page, board)
    assert page.inner_text("#finish-title") == "Found"
    assert page.inner_text("#finish .facts") == "7.0 m driven in 4.0 s, 1.0 m from the goal"
    assert page.locator("#finish .film img").count() == 6
    eventually(lambda: run_in(page, GREY.format("#finish")) > 250)
    route = "document.querySelectorAll('#finish canvas')[1].toDataURL()"
    before = run_in(page, route)
    page.focus("#finish input")
    page.keyboard.press("Home")
    eventually(lambda: run_in(page, GREY.format("#finish")) < 40)
    assert run_in(page, route) != before
    assert page.get_attribute("#finish input", "aria-valuetext") == "0.0 s of 3.5 s"
    assert page.is_hidden("#report")
    board.put(
        "library",
        {"folder": "drives", "models": [], "recordings": [recording("a") | {"episode": "run-1"}]},
    )
    page.wait_for_selector("#report:visible")
    assert page.get_attribute("#report", "href") == "report?of=drives%2Fa.mcap"
    for number, size in enumerate([(1024, 768), (1920, 1080), (800, 600)], 1):
        page.set_viewport_size({"width": size[0], "height": size[1]})
        text = f"{number}: victim-2026-11-29T10-00: cannot be read: not an MCAP file, or damaged"
        board.put("news", [{"number": number, "at": board.clock(), "text": text}])
        page.wait_for_selector(f"#latest:has-text('{number}: victim')")
        for end in (0, "document.body.scrollHeight"):
            run_in(page, f"scrollTo(0, {end})")
            assert run_in(page, COVERED) == []
    page.set_viewport_size({"width": 390, "height": 844})
    assert run_in(page, "document.documentElement.scrollWidth") == 390
    assert run_in(page, SMALL) == []
    page.click("#close-finish")
    page.wait_for_selector("#run-form:visible")
    page.click("#last-run")
    page.wait_for_selector("#finish:visible")
    page.click("#steps [data-panel=more]")
    assert page.is_hidden("#finish")
    page.click("#steps [data-panel=run]")
    page.wait_for_selector("#finish:visible")
    assert page.get_attribute("#steps [data-panel=run]", "aria-pressed") == "true"
    board.put("robot", DRIVE | {"purpose": "run", "episode": "run-2", "at": board.clock()})
    page.wait_for_selector("#run-form:visible")
    assert page.is_hidden("#last-run")  # the card waits for the end of a run


def test_finish_is_there_again_after_a_reload(
    page: Page, nobody: Nobody, board: Board, tmp_path: Path
) -> None:
    library = nobody.library
    (tmp_path / "drives").mkdir()
    for name in ("run-before", "run-1"):
        messages = list(recorded_messages.episode(name, frames=12, purpose="run"))
        test_recorder_files.record(tmp_path / "drives", messages)
    board.put("library", library.look())
    run_and_find(page, board)
    page.reload()
    page.wait_for_selector("#finish:visible")
    assert page.inner_text("#finish-title") == "Found"
    assert page.inner_text("#finish .facts") == "7.0 m driven in 1.1 s, 1.0 m from the goal"
    assert page.locator("#finish .film img").count() == 6
    assert page.get_attribute("#finish input", "aria-valuetext") == "1.1 s of 1.1 s"
    assert page.get_attribute("#report", "href") == "report?of=drives%2Frun-1.mcap"
    page.click("#steps [data-panel=learn]")
    listed = page.locator("#recordings .report")
    assert {one.get_attribute("href") for one in listed.all()} == {
        f"report?of=drives%2F{name}.mcap" for name in ("run-before", "run-1")
    }
    # A drive since then: the card waits until it is asked for.
    board.put(
        "robot",
        DRIVE | {"episode": None, "outcome": "found", "result": "found", "at": board.clock()},
    )
    board.put("driven", {"episode": "drive-1", "metres": 3.0})
    board.put("goal", {"episode": "drive-1", "at": None, "boxes": []})
    page.reload()
    page.click("#steps [data-panel=run]")
    assert page.is_hidden("#finish")
    page.click("#last-run")
    page.wait_for_selector("#finish:visible")
    metres = library.recordings()[0].metres
    assert page.inner_text("#finish .facts") == f"{metres:.1f} m driven in 1.1 s"


LONG_RUN = """new Promise((done) => document.querySelector("#camera canvas").toBlob(done)).then(async (picture) => {
    const { keepPicture } = await import("/finish.js"), robot = { episode: "long", purpose: "run" };
    for (let k = 0; k < 10_000; k++) keepPicture({ robot: { ...robot, seconds: k / 5 } }, picture);
})"""


def test_time_line_covers_a_long_run_in_300_pictures(page: Page, board: Board) -> None:
    run_in(page, LONG_RUN)
    ended = {"episode": None, "outcome": "timeout", "result": "out of time", "seconds": 2000.0}
    board.put("robot", RUN | ended | {"at": board.clock()})
    page.wait_for_selector("#finish:visible")
    assert 150 <= int(page.get_attribute("#finish input", "max")) <= 300
    assert page.get_attribute("#finish input", "aria-valuetext") == "33 min of 33 min"
    page.focus("#finish input")
    page.keyboard.press("Home")
    assert page.get_attribute("#finish input", "aria-valuetext") == "0.0 s of 33 min"


def test_video_of_a_run_holds_camera_and_map(page: Page, board: Board, tmp_path: Path) -> None:
    run_and_find(page, board)
    with page.expect_download() as download:
        page.click("#save-video")
    assert download.value.suggested_filename.startswith("run-1.")
    file = tmp_path / download.value.suggested_filename
    download.value.save_as(file)
    video = cv2.VideoCapture(str(file))
    frames = []
    while (read := video.read())[0]:
        frames.append(read[1])
    assert frames[0].shape == (528, 1280, 3)
    # The camera on the left turns from dark to white; on the right the robot moves on the map.
    grey = [frame[200:280, 280:360].mean() for frame in frames]
    assert grey[0] < 50
    assert grey[-1] > 235
    assert np.abs(frames[0][:480, 640:].astype(int) - frames[-1][:480, 640:]).max() > 50
    page.wait_for_selector("#save-video:text-is('Save as video')")
