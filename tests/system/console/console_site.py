"""A stack with its page, a browser that opens it, and the actions of a person."""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from playwright.sync_api import Error

from schemas import topics
from schemas.codec import decode
from schemas.command import CommandApplied
from schemas.episode import Episode
from schemas.motion import TruePose
from schemas.rpc import Nothing, Status
from services.cli.stack import Stack
from services.expert.driver import RouteDriver
from services.kit.bus import Bus, RpcError
from services.simulator.world import load_world
from services.simulator.world.route import plan_route
from tests.services.waiting import collected, eventually, status_of

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

KEYS = {"forward": "w", "left": "a", "right": "d", "backward": "s"}
SPEED_M_S = 2.0
AGAIN_S = 15.0  # After so long a person presses a button again.


class Site:
    """A stack with its page, and the robot's true motion."""

    def __init__(self, address: str, stack: Stack, bus: Bus, root: Path) -> None:
        self.address = address
        self.stack = stack
        self.bus = bus
        self.root = root
        self.poses: list[TruePose] = collected(bus, topics.POSE)
        self.applied: list[tuple[float, CommandApplied]] = []  # What moved the robot, since when.
        bus.subscribe(topics.APPLIED, self._note)
        self.ended = ""  # The episode that ended last: from then on the robot stands, and tells no more of it.
        bus.subscribe(topics.EPISODE, self._note_end)

    def _note(self, payload: bytes, encoding: str, _transit_s: float | None) -> None:
        self.applied.append((time.monotonic(), decode(CommandApplied, payload, encoding)))

    def _note_end(self, payload: bytes, encoding: str, _transit_s: float | None) -> None:
        event = decode(Episode, payload, encoding)
        if event.event == "ended":
            self.ended = event.episode

    @property
    def drives(self) -> bool:
        """Whether the robot is being moved."""
        last = self.applied[-1][1] if self.applied else None
        return last is not None and last.atom != "stop" and last.episode != self.ended

    def stood_s(self, since_s: float) -> float:
        """Wait until the actuator stands; return how long after a time it was last told to move."""
        eventually(lambda: not self.drives)
        return (
            max((at for at, one in self.applied if one.atom != "stop"), default=since_s) - since_s
        )

    def pid_of_console(self) -> int:
        """Wait until the console answers; return its process id."""
        status = eventually(lambda: status_of(self.bus, "console"))
        return status.pid

    def robot(self, key: str) -> object:
        """Return an entry of the status of the robot."""
        with suppress(RpcError):
            return self.bus.call("robot", "status", Nothing(), Status).detail[key]
        return None


@contextmanager
def opened(browser: Browser, site: Site, by: str | None = None) -> Iterator[Page]:
    """Open the page in a context of its own, as another person would; no error may appear in it.

    ``by`` is another address that leads to it.
    """
    context = browser.new_context(viewport={"width": 1440, "height": 1000})
    page = context.new_page()
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(f"http://{by or site.address}/")
    eventually(lambda: told(page) and "onnect" not in told(page))
    try:
        yield page
    finally:
        if not page.is_closed():
            # pytest shows it where the test has failed.
            sys.stdout.write(
                "\n".join(page.inner_text(part) for part in ("#status", "#job", "#news")) + "\n"
            )
        context.close()
    assert errors == []


def told(page: Page) -> str:
    """Return the line of the page with the robot's status."""
    return page.inner_text("#status")


def data(page: Page, name: str) -> str:
    """Return an attribute of the episode on the page."""
    return page.get_attribute("body", f"data-{name}") or ""


def begin_a_drive(page: Page, site: Site, world: str = "yard") -> None:
    """Begin a drive in a world."""
    show(page, "Teach")
    eventually(lambda: page.locator(f"#world-form option[value='{world}']").count() == 1)
    page.select_option("#world-form [name=world]", world)
    before = data(page, "episode")
    insist(
        page,
        site,
        lambda: act(page, "Begin a drive"),
        # Pressed twice, it has begun two, and the page follows.
        lambda: (
            data(page, "episode") not in ("", before)
            and site.poses
            and site.poses[-1].episode == data(page, "episode")
        ),
    )


def show(page: Page, panel: str) -> None:
    """Show a step or the details; a running episode is ended first, since it keeps its own step."""
    if data(page, "episode") and panel != "Details":
        _press(page, ":is([data-does=end], [data-does=quit])")
        act(page, "Really end?")
        eventually(lambda: data(page, "episode") == "")
    page.click(f"#steps button:has-text('{panel}')")


def act(page: Page, name: str) -> None:
    """Press a button of the header, if it is there."""
    _press(page, f"button:has-text('{name}')")


def _press(page: Page, selector: str) -> None:
    with suppress(Error):
        page.click(f"#actions {selector}", timeout=5000.0)


def drive_ahead(page: Page, site: Site) -> None:
    """Begin a drive, and hold the key for ahead."""
    begin_a_drive(page, site)
    hold(page, site, lambda: page.keyboard.down("w"))


def insist(page: Page, site: Site, press: Callable[[], None], done: Callable[[], object]) -> None:
    """Press something until it is done: a busy machine loses the robot's operator meanwhile, or an answer."""
    press()
    pressed_s = time.monotonic()

    def is_done() -> object:
        nonlocal pressed_s
        if was_lost(page, site) or time.monotonic() > pressed_s + AGAIN_S:
            press()
            pressed_s = time.monotonic()
        return done()

    eventually(is_done, timeout_s=120.0)


def hold(page: Page, site: Site, press: Callable[[], None], atom: str = "forward") -> None:
    """Press something until the robot moves by it."""
    insist(page, site, press, lambda: site.drives and site.applied[-1][1].atom == atom)


def arm(page: Page, site: Site) -> bool:
    """Arm the robot, as often as it takes: a busy machine loses its operator once more meanwhile."""

    def armed() -> bool:
        act(page, "Resume")
        with suppress(pytest.fail.Exception):
            return eventually(lambda: site.robot("stop_cause") is None, timeout_s=2.0)
        return False

    return eventually(armed, timeout_s=120.0)


def was_lost(page: Page, site: Site) -> bool:
    """Arm a robot that had lost its operator, since the machine was busy elsewhere; a person would go on as well."""
    # Between episodes the page offers no “Resume”: the next drive or run arms the robot.
    if site.robot("stop_cause") != "operator_lost" or site.robot("episode") is None:
        return False
    for key in KEYS.values():
        page.keyboard.up(key)
    return arm(page, site)


def drive_to_the_victim(page: Page, site: Site, name: str) -> None:
    """Drive by keys, as the scripted expert would."""
    world = load_world(site.root / "worlds" / f"{name}.json")
    here = site.poses[-1]
    driver = RouteDriver(plan_route(world, (here.x_m, here.y_m)), SPEED_M_S, world.scale.found_m)
    held = ""
    while not driver.arrived(here.x_m, here.y_m):
        key = KEYS[driver.key(here.x_m, here.y_m, here.heading_rad)]
        if key != held:
            if held:
                page.keyboard.up(held)
            page.keyboard.down(key)
            held = key
        if was_lost(page, site):
            held = ""
        eventually(lambda seen=here: site.poses[-1] is not seen)
        here = site.poses[-1]
    page.keyboard.up(held)


def run_in(page: Page, script: str) -> Any:
    """Run a script as the developer's tools do; the page's own policy forbids what Playwright would do."""
    tools = page.context.new_cdp_session(page)
    asked = {"expression": script, "awaitPromise": True, "returnByValue": True}
    answer = tools.send("Runtime.evaluate", asked)
    assert "exceptionDetails" not in answer, answer
    tools.detach()
    return answer["result"].get("value")


def drop(page: Page, file: Path, name: str) -> None:
    """Drop a file on the map, as from a folder's window."""
    run_in(page, "var dropped = new DataTransfer()")
    run_in(
        page, f"dropped.items.add(new File([{json.dumps(file.read_text())}], {json.dumps(name)}))"
    )
    event = "new DragEvent('drop', {dataTransfer: dropped, bubbles: true, cancelable: true})"
    run_in(page, f"document.querySelector('#map').dispatchEvent({event})")


@contextmanager
def frozen(pid: int) -> Iterator[None]:
    os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(pid, signal.SIGCONT)
