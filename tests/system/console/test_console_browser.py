"""The page in a real browser on the real stack: clicks and keys drive the robot, and it stands in time."""

from __future__ import annotations

import os
import re
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import TYPE_CHECKING

import pytest

from services.robot.loop import STAND_WITHIN_S
from services.simulator.world.loading import WORLDS_FOLDER
from tests.benchmarks.faults.proxy import link
from tests.services.waiting import eventually
from tests.system.console.console_site import (
    Site,
    act,
    arm,
    begin_a_drive,
    data,
    drive_ahead,
    drive_to_the_victim,
    drop,
    frozen,
    hold,
    insist,
    opened,
    run_in,
    show,
    told,
    was_lost,
)

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = [pytest.mark.system, pytest.mark.rendering, pytest.mark.zenoh]
Lost = Callable[[float], float]


def test_teach_once_learn_run_found(page: Page, site: Site) -> None:
    """By clicks and keys alone."""
    begin_a_drive(page, site, "near")
    page.click("#enlarge")
    eventually(lambda: page.is_visible("#map .victim"))
    page.click("#enlarge")
    drive_to_the_victim(page, site, "near")
    act(page, "Found: end here")
    eventually(lambda: told(page).startswith("You reached the goal"))
    eventually(lambda: page.locator("#recordings input:checked").count() == 1)
    act(page, "Learn")
    eventually(lambda: "way-1 is learned" in page.inner_text("#job"), timeout_s=240.0)
    eventually(lambda: page.locator("#run-form select[name=model] option").count() == 1)
    insist(
        page,
        site,
        lambda: act(page, "Run"),
        lambda: data(page, "episode").startswith("run"),
    )
    eventually(lambda: page.locator("#belief img").get_attribute("src"))
    eventually(lambda: not was_lost(page, site) and data(page, "episode") == "", timeout_s=120.0)
    assert re.fullmatch(r"Found: \d\.\d m from the goal, [\d.]+ (s|min)", told(page))
    assert run_in(page, "document.querySelector('#belief img').naturalWidth") == 160
    facts = r"[\d.]+ m driven in [\d.]+ (s|min), \d\.\d m from the goal"
    assert re.fullmatch(facts, page.inner_text("#finish .facts"))
    with page.context.expect_page() as opened_page:
        page.click("#report")
    assert "Run to victim" in opened_page.value.inner_text("h1")
    assert opened_page.value.locator("svg polyline").count() == 1


@pytest.mark.long
def test_map_becomes_a_world_when_it_is_dropped(page: Page, site: Site) -> None:
    show(page, "Teach")
    drop(page, WORLDS_FOLDER / "yard.osm", "My town!.osm")
    world = page.locator("#world-form [name=world]")
    eventually(lambda: world.input_value() == "My town-", timeout_s=120.0)
    show(page, "Teach")  # The result of the run before can have opened its own panel.
    page.select_option("#world-form [name=variation]", "dark")
    page.fill("#drive-form [name=name]", "By night")
    page.select_option("#world-form [name=world]", "My town-")
    insist(
        page,
        site,
        lambda: act(page, "Begin a drive"),
        lambda: (
            data(page, "episode").startswith("by-night-")
            and "in My town-" in page.text_content("#episode")
        ),
    )
    assert site.robot("variation") == "dark"
    act(page, "Give up")
    act(page, "Really end?")
    eventually(lambda: data(page, "episode") == "")


def in_page(script: str) -> Callable[[Page], None]:
    return lambda page: run_in(page, script)


GAMEPAD = "navigator.getGamepads = () => [null, {buttons: [{}, {pressed: true}], axes: [0, 0]}]"
#: A browser without a window brings no other tab to the front by itself.
HIDE = """Object.defineProperty(document, 'hidden', {value: true});
    document.dispatchEvent(new Event('visibilitychange'))"""
FATES: dict[str, Callable[[Page], None]] = {
    "reloaded": in_page("location.reload()"), "closed": lambda page: page.close(), "hidden": in_page(HIDE)
}  # fmt: skip
#: What lets go of a key that is still down, and what is done about it.
LETS_GO: dict[str, tuple[Callable[[Page], None], Callable[[Page], None]]] = {
    "without focus": (in_page("window.dispatchEvent(new Event('blur'))"), lambda _: None),
    # Then the page hears of no key that is let go; nor while something is dragged, nor with Meta.
    "menu": (
        in_page("document.body.dispatchEvent(new Event('contextmenu', {bubbles: true}))"),
        lambda _: None,
    ),
    "dragged": (
        in_page("document.body.dispatchEvent(new Event('dragstart', {bubbles: true}))"),
        lambda _: None,
    ),
    "with Meta": (lambda page: page.keyboard.down("Meta"), lambda page: page.keyboard.up("Meta")),
    "stopped by Escape": (lambda page: page.keyboard.press("Escape"), lambda _: None),
    "stopped by the red button": (lambda page: page.click("#stop"), lambda _: None),
    "stopped by gamepad": (in_page(GAMEPAD), in_page("navigator.getGamepads = () => []")),
}


def stands_in_time(
    page: Page, site: Site, lost_s: Lost, befalls: Callable[[Page], None], name: str
) -> None:
    """Have something befall a page by which the robot moves."""
    # Chromium takes its time for some of these: the robot is watched meanwhile, on a thread of the bus.
    began_s = time.monotonic()
    befalls(page)
    took_s = time.monotonic() - began_s
    assert site.stood_s(began_s) <= took_s + STAND_WITHIN_S + lost_s(began_s), name


@pytest.mark.parametrize("fate", FATES)
def test_robot_stands_when_its_page_is_gone(
    browser: Browser, site: Site, lost_s: Lost, fate: str
) -> None:
    with opened(browser, site) as page:
        drive_ahead(page, site)
        stands_in_time(page, site, lost_s, FATES[fate], fate)


def test_robot_stands_when_its_key_is_released(page: Page, site: Site, lost_s: Lost) -> None:
    drive_ahead(page, site)
    for name, (befalls, undo) in LETS_GO.items():
        hold(page, site, lambda: (page.keyboard.up("w"), page.keyboard.down("w")))
        stands_in_time(page, site, lost_s, befalls, name)
        undo(page)
        page.keyboard.up("w")
        if name.startswith("stopped"):
            eventually(lambda: site.robot("stop_cause") == "emergency_stop")
            arm(page, site)

    def press() -> None:
        page.mouse.up()
        page.hover("#pad [data-atom=left]")
        page.mouse.down()

    hold(page, site, press, "left")
    stands_in_time(page, site, lost_s, lambda page: page.mouse.up(), "pad")


# -- faults -----------------------------------------------------------------------------------------------------------


@contextmanager
def killed(site: Site) -> Iterator[None]:
    """Kill the console; whoever looks after the stack starts it again."""
    os.kill(site.pid_of_console(), signal.SIGKILL)
    try:
        yield
    finally:
        eventually(lambda: "console" in site.stack.restart_dead())
        site.pid_of_console()


@pytest.mark.long
def test_robot_stands_without_its_console_until_it_is_armed(
    browser: Browser, site: Site, lost_s: Lost
) -> None:
    faults: tuple[tuple[Callable[[int], AbstractContextManager[None]], str], ...] = (
        (lambda _: frozen(site.pid_of_console()), "The console has been silent for"),
        (frozen, "The console has been silent for"),  # the link
        (lambda _: killed(site), "Not connected to the console for"),
    )
    with (
        link(f"tcp/{site.address}") as way,
        opened(browser, site, way.address.removeprefix("tcp/")) as page,
    ):
        drive_ahead(page, site)
        for fault, says in faults:
            began_s = time.monotonic()
            with fault(way.pid):
                assert site.stood_s(began_s) <= STAND_WITHIN_S + lost_s(began_s)
                eventually(lambda says=says: told(page).startswith(says))
            # The key is still down.
            eventually(lambda: "console" not in told(page))
            said = len(site.applied)
            eventually(lambda said=said: len(site.applied) > said + 10)
            assert not site.drives
            assert site.robot("stop_cause") is not None
            page.keyboard.up("w")
            arm(page, site)
            hold(page, site, lambda: page.keyboard.down("w"))


def test_page_warns_when_a_stop_may_be_late(page: Page, site: Site) -> None:
    with frozen(site.pid_of_console()):
        eventually(lambda: told(page).startswith("The console has been silent for"))
        page.keyboard.press("Escape")
        eventually(
            lambda: (
                "The console does not answer: the emergency stop may be late."
                in page.text_content("#news")
            )
        )
    eventually(lambda: "Emergency stop" in told(page))
    arm(page, site)
