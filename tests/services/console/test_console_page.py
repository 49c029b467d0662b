"""What the page makes of what it is told, in a real browser, without a stack."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from services.console.config import ConsoleSettings
from services.console.newest_content import Board
from services.console.server import WebServer
from tests.services.console.conftest import Nobody
from tests.services.waiting import eventually

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = pytest.mark.system


@pytest.fixture
def board() -> Board:
    return Board()


@pytest.fixture
def page(browser: Browser, nobody: Nobody, board: Board, tmp_path: Path) -> Iterator[Page]:
    """Open the page; a test in which its script fails has failed."""
    server = WebServer(nobody, board, ConsoleSettings(root=tmp_path, console="127.0.0.1:0"))  # type: ignore[arg-type]
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
    page.click("#drive-form button")
    return eventually(lambda: nobody.asked.pop() if nobody.asked else None)


@pytest.mark.parametrize("name", ["map (1)", "Berlin, Mitte", "x" * 100, "#7", "<img src=x onerror=alert(1)>"])
def test_a_robot_whose_world_has_a_name_that_cannot_be_asked_for_is_driven_there(
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


@pytest.mark.parametrize("told", [{"worlds": "x"}, {"worlds": 5, "variations": 3}, {"worlds": "x", "variation": True}])
def test_what_another_robot_tells_of_worlds_breaks_nothing(
    page: Page, nobody: Nobody, board: Board, told: dict[str, object]
) -> None:
    tell_robot(board, world="x", **told)
    page.wait_for_selector("#world-form:visible")
    board.put("robot", {"answers": True, "episode": None, "outcome": "found"})
    eventually(lambda: "Armed" in page.inner_text("#status"))
    assert begin(page, nobody).variation is None


def test_who_drives_sees_how_long_the_recorder_has_room(page: Page, board: Board) -> None:
    row = {"name": "recorder", "ailment": None, "idle": 0.0, "rates": {}, "dropped": 0, "bad": 0, "failed": 0}
    board.put("health", {"services": [row | {"told": {"disk": "the disk has room for 9 minutes more"}}]})
    page.wait_for_selector("#disk:visible")
    assert page.inner_text("#disk") == "Recording: the disk has room for 9 minutes more"
    board.put("health", {"services": [row | {"told": {}}]})
    page.wait_for_selector("#disk", state="hidden")


def test_the_page_follows_the_robot_into_the_world_that_somebody_else_has_chosen(page: Page, board: Board) -> None:
    tell: Callable[[str], None] = lambda world: tell_robot(  # noqa: E731
        board, world=world, worlds="campus, yard", variation="day", variations="day, dark"
    )
    tell("yard")
    page.wait_for_selector("#world-form:visible")
    page.select_option("#world-form [name=variation]", "dark")
    tell("campus")
    eventually(lambda: choice(page, "world") == "campus")
    assert choice(page, "variation") == "dark", "that is still one's own choice"


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
    page.wait_for_selector("#recordings input")
    page.fill("#learn-form [name=name]", "way")
    if scheme == "paper":
        page.select_option("#learn-form [name=scheme]", scheme)
    page.click("#seat")
    page.click("#learn-form button")
    ask = eventually(lambda: next((ask for ask in nobody.asked if ask.do == "learn"), None))
    assert (ask.name, ask.scheme, ask.recordings) == ("way", scheme, ("drives/a-s-1.mcap",))


@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("Ko\u0308ln (Süd).osm", "Köln (Süd)"),
        ("हिन्दी.osm", "हिन्दी"),
        ("½.osm", "map"),
        ("..%2F..\\etc.osm", "2F..-etc"),
        ("𠀀" * 63 + ".osm", "𠀀" * 50),
    ],
)
def test_a_map_s_file_name_becomes_a_world_s_name_that_may_be(
    page: Page, nobody: Nobody, board: Board, file: str, name: str
) -> None:
    tell_robot(board, world="yard", worlds="campus, yard", variation="day", variations="day, dark")
    page.wait_for_selector("#world-form:visible")
    page.set_input_files("#world-form [name=map]", {"name": file, "mimeType": "", "buffer": b"<osm/>"})
    assert eventually(lambda: nobody.maps or page.locator("#news li").count() > 1) == [(name, b"<osm/>")]


def recording(name: str) -> dict[str, object]:
    facts = {"when_s": 1.0, "size": 1, "purpose": "drive", "goal": "victim", "world": "yard", "outcome": "found"}
    shown = {"frames": 9, "seconds": 1.0, "useless": "", "thumbnails": 0}
    return {"name": f"drives/{name}.mcap", "episode": name, **facts, **shown}


def test_who_is_in_the_list_of_recordings_stays_there_when_it_grows(page: Page, board: Board) -> None:
    tell_robot(board, world="yard", worlds="yard", variation="day", variations="day")
    board.put(
        "library",
        {
            "folder": "drives",
            "models": [],
            "recordings": [recording("b-s-2") | {"corrected": True}, recording("a-s-1")],
        },
    )
    boxes = page.locator("#recordings input")
    eventually(lambda: boxes.evaluate_all("all => all.map(({checked}) => checked)") == [True, True])
    told = page.locator("#recordings small").all_inner_texts()
    assert ["corrected by hand" in text for text in told] == [True, False]
    boxes.nth(1).uncheck()
    boxes.nth(1).focus()
    names = ["c-s-3", "a-s-1"]
    board.put("library", {"folder": "drives", "models": [], "recordings": [recording(name) for name in names]})
    eventually(
        lambda: boxes.evaluate_all("all => all.map(({value}) => value)") == [f"drives/{one}.mcap" for one in names]
    )
    assert boxes.evaluate_all("all => all.map(({checked}) => checked)") == [True, False]
    assert page.evaluate("document.activeElement.value") == "drives/a-s-1.mcap"


def test_what_is_being_begun_is_cancelled_by_who_drives(page: Page, nobody: Nobody, board: Board) -> None:
    told = {"episode": None, "answers": True, "emergency": False, "at": 0.0}
    board.put("robot", told | {"waiting": True})
    page.wait_for_selector("#camera .empty:has-text('Waiting for the robot')")
    assert not page.is_visible("#withdraw"), "who watches cancels nothing"
    page.click("#seat")
    page.click("#withdraw")
    eventually(lambda: [ask.do for ask in nobody.asked] == ["withdraw"])
    board.put("robot", told | {"waiting": False})
    page.wait_for_selector("#withdraw", state="hidden")


def test_who_runs_a_model_is_warned_where_it_was_taught_in_another_world(page: Page, board: Board) -> None:
    models = [{"name": "models/way.smal", "goals": ["victim"], "worlds": ["campus"], "useless": ""}]
    board.put("library", {"folder": "drives", "recordings": [], "models": models})
    tell_robot(board, world="yard", worlds="campus, yard", variation="day", variations="day")
    warned = page.locator("#elsewhere")
    said = "way was taught in campus, and this run is in yard: it knows no way there."
    eventually(lambda: warned.inner_text() == said)
    page.select_option("#world-form [name=world]", "campus")
    eventually(lambda: warned.inner_text() == "")
    page.select_option("#world-form [name=world]", "yard")
    eventually(lambda: warned.inner_text() == said)
    tell_robot(board, world="campus", worlds="campus, yard", variation="day", variations="day")
    eventually(lambda: warned.inner_text() == "")
