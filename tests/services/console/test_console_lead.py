"""The header of the page: one sentence and one next action, derived from one state."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from services.console.config import ConsoleSettings
from services.console.newest_content import Board
from services.console.server import WebServer
from tests.services.console.conftest import Nobody
from tests.system.console.console_site import run_in

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = pytest.mark.system

IDLE = {"answers": True, "waiting": False, "emergency": False, "episode": None, "cause": None,
        "outcome": None, "right": None, "purpose": None, "seconds": None}  # fmt: skip
DRIVE = IDLE | {
    "episode": "e", "purpose": "drive", "driver": "teleop", "source": "teleop", "goal": "victim",
    "reason": "command", "tick": 300, "seconds": 30.0, "rate_hz": 10.0,
}  # fmt: skip
RUN = DRIVE | {"purpose": "run", "driver": "policy", "source": "policy"}
FOUND = RUN | {"episode": None, "outcome": "found", "result": "found", "seconds": 41.0}
NOT_HERE = FOUND | {
    "outcome": "not_here",
    "right": True,
    "result": "it reported “not here”, rightly",
}
LEARNS = {"kind": "model", "name": "w", "doing": "Learning w", "stage": "matching", "share": 0.4,
          "left_s": 20.0}  # fmt: skip
FAILED = LEARNS | {"outcome": "failed", "why": "no goal in view"}
TAUGHT = {"drives": 1, "untaught": True}
LEARNED = {"drives": 1, "models": 1}
SLOW = "This computer is too slow for real time (4 of 10 frames a second)"
STATES: dict[str, tuple[dict[str, Any], tuple[str, str, str, str]]] = {
    "nothing is taught": (
        {"robot": IDLE | {"cause": "not_armed"}},
        ("teach", "good", "Drive to the goal once; then the robot finds the way by itself", "drive"),
    ),
    "a drive is taught": (
        {"robot": FOUND | {"purpose": "drive"}, **TAUGHT},
        ("learn", "good", "You reached the goal: 41 s. Now let the robot learn the way", "learn"),
    ),
    "a second drive is not listed yet": (
        {"robot": FOUND | {"purpose": "drive"}, **LEARNED, "unlisted": True},
        ("learn", "good", "You reached the goal: 41 s. Now let the robot learn the way", "learn"),
    ),
    "it learns": ({"robot": IDLE, "job": LEARNS}, ("learn", "good", "Learning w …", "cancel")),
    "learning fails": (
        {"robot": IDLE, "job": FAILED, **TAUGHT},
        (
            "learn",
            "bad",
            "Learning w failed: no goal in view. Select other drives below, or teach again",
            "learn",
        ),
    ),
    "it is learned but not listed yet": (
        {"robot": IDLE, "job": LEARNS | {"outcome": "done"}, **TAUGHT},
        ("run", "good", "Now let the robot find the way by itself", "run"),
    ),
    "it is learned": (
        {"robot": IDLE, **LEARNED},
        ("run", "good", "Now let the robot find the way by itself", "run"),
    ),
    "a run is asked for": (
        {"robot": FOUND | {"purpose": "drive", "waiting": True}, "chosen": "run", **TAUGHT},
        ("run", "warn", "Waiting for the robot …", "withdraw"),
    ),
    "a run is refused": (
        {"robot": FOUND | {"purpose": "drive"}, "chosen": "run", "refused": "no room", **TAUGHT},
        ("run", "warn", "No room", "run"),
    ),
    "it has found": (
        {"robot": FOUND, "distance": 0.41, **LEARNED},
        ("run", "good", "Found: 0.4 m from the goal, 41 s", "run"),
    ),
    "the operator is lost after the end": (
        {"robot": NOT_HERE | {"cause": "operator_lost"}, **LEARNED},
        ("run", "good", "It reported “not here”, rightly: 41 s", "run"),
    ),
    "the robot is dead": (
        {"robot": FOUND | {"answers": False}, "age": 12.0, **LEARNED},
        ("run", "old", "The robot does not answer for 12 s", "run"),
    ),
    "the computer was busy": (
        {"robot": RUN | {"cause": "operator_lost"}, "sits": True},
        ("run", "warn", "It stands: this computer was busy. Drive on, or press “Resume”", "resume"),
    ),
    "the driver has left": (
        {"robot": RUN | {"cause": "operator_lost"}},
        (
            "run",
            "warn",
            "The robot stands: its driver has left. Press “Resume” to continue",
            "resume",
        ),
    ),
    "the computer is slow": (
        {"robot": RUN | {"rate_hz": 4.0}, **LEARNED},
        ("run", "warn", SLOW, "quit"),
    ),
    "an obstacle stops a slow run": (
        {"robot": RUN | {"rate_hz": 4.0, "reason": "obstacle"}, "sits": True},
        ("run", "warn", "An obstacle slows down or stops the robot; hold a key to correct it", "quit"),
    ),
    "a person has taken over a slow run": (
        {"robot": RUN | {"rate_hz": 4.0, "source": "teleop", "reason": "taken_over"}},
        ("run", "warn", "You drive: press “Resume”, and the robot goes on by itself", "resume"),
    ),
    "a stop is latched": (
        {"robot": RUN | {"cause": "emergency_stop"}},
        ("run", "bad", "Emergency stop: the robot stands until you press “Resume”", "resume"),
    ),
    "a person teaches": (
        {"robot": DRIVE, "sits": True},
        ("teach", "good", "Drive to victim, then press “Found”", "found"),
    ),
    "it is stuck": (
        {"robot": RUN, "plan": "dead_end", "sits": True},
        ("run", "warn", "The robot has no route from here; hold a key to correct it", "quit"),
    ),
    "it drives by itself": (
        {"robot": RUN, **TAUGHT},
        ("run", "good", "The robot drives to victim by itself", "quit"),
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def page(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """Open the page."""
    root = tmp_path_factory.mktemp("root")
    settings = ConsoleSettings(root=root, console="127.0.0.1:0")
    server = WebServer(Nobody(Path(root)), Board(), settings)
    page = browser.new_page()
    page.goto(server.address)
    yield page
    page.close()
    server.close()


def led_by(page: Page, state: dict[str, Any]) -> dict[str, Any]:
    """Return the header of a state."""
    common = {
        "robot": None, "job": None, "chosen": None, "link": "", "age": 0.1, "ill": "", "unattended": True,
        "frames_hz": 10, "sits": False, "taken": False, "distance": None, "drives": 0, "models": 0,
        "untaught": False, "unlisted": False,
    }  # fmt: skip
    asked = json.dumps(common | state)
    led: dict[str, Any] = run_in(page, f"import('./lead.js').then(({{lead}}) => lead({asked}))")
    return led


@pytest.mark.parametrize("name", STATES)
def test_header_leads_when(page: Page, name: str) -> None:
    state, wanted = STATES[name]
    led = led_by(page, state)
    assert (led["step"], led["level"], led["text"], led["does"][0]) == wanted


def test_header_names_the_arrow_pad_when_a_finger_drives(browser: Browser, page: Page) -> None:
    with browser.new_context(has_touch=True, is_mobile=True) as phone:
        touched = phone.new_page()
        touched.goto(page.url)
        waits = {"robot": DRIVE | {"reason": "silence"}}
        texts = [led_by(touched, state)["text"] for state, _ in [*STATES.values(), (waits, None)]]
        assert not touched.locator("#stop kbd").is_visible()
    assert texts[-1] == "Take control, then hold the arrow pad to drive"
    assert "The robot has no route from here; hold the arrow pad to correct it" in texts
    assert [text for text in texts if " key" in text] == []
