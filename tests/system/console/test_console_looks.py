"""The page by keys alone, by day and night, on narrow screens."""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from services.robot.loop import STAND_WITHIN_S
from services.simulator.world import load_world
from services.simulator.world.route import plan_route
from tests.services.waiting import eventually
from tests.system.console.console_site import Site, act, data, hold, insist, run_in, show

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = [pytest.mark.system, pytest.mark.rendering, pytest.mark.zenoh]


@pytest.fixture
def taught_here(site: Site, taught: Path) -> Iterator[None]:
    """Have a model, and the recording that it was learned from, where the page finds them."""
    files = {taught / "model.smal": site.root / "models" / "taught.smal"}
    files |= {one: site.root / "drives" / one.name for one in (taught / "drives").glob("*.mcap")}
    for here, there in files.items():
        there.parent.mkdir(exist_ok=True)
        shutil.copy(here, there)
    yield
    for there in files.values():
        there.unlink()


def begin_a_run(page: Page, site: Site) -> None:
    """Begin a run where it was taught, and see the first belief."""
    name = "models/taught.smal"
    show(page, "Teach")
    eventually(lambda: page.locator("#world-form option[value=near]").count() == 1)
    page.select_option("#world-form [name=world]", "near")
    eventually(lambda: page.locator(f"#run-form option[value='{name}']").count() == 1)
    show(page, "Run")
    page.select_option("#run-form select[name=model]", name)
    insist(
        page,
        site,
        lambda: act(page, "Run"),
        lambda: data(page, "episode").startswith("run"),
    )
    eventually(lambda: page.locator("#belief img").get_attribute("src"))


SIZES = {1440: 900, 1024: 768, 390: 844}
# Violations that axe-core reports, with their elements.
VIOLATIONS = """axe.run({resultTypes: ["violations"]}).then(({violations}) => violations.map(
    ({id, nodes}) => `${id}: ${nodes.map(({target}) => target.join(" ")).join(", ")}`))"""


@pytest.mark.long
@pytest.mark.usefixtures("taught_here")
def test_axe_core_finds_no_violation(page: Page, site: Site) -> None:
    axe = pytest.importorskip(
        "axe_playwright_python.base", reason="axe-playwright-python is not installed"
    )
    run_in(page, f"{axe.AXE_SCRIPT}; 0")

    def violations(
        *panels: str, sizes: dict[int, int] = SIZES
    ) -> dict[tuple[str, int, str], list[str]]:
        found = {}
        for scheme in ("light", "dark"):
            page.emulate_media(color_scheme=scheme)
            for width, height in sizes.items():
                page.set_viewport_size({"width": width, "height": height})
                for panel in panels or ("",):
                    if panel:
                        page.click(f"#steps [data-panel={panel}]")
                    found[scheme, width, panel] = run_in(page, VIOLATIONS)
        page.set_viewport_size({"width": 1440, "height": SIZES[1440]})
        return {where: wrong for where, wrong in found.items() if wrong}

    assert violations("teach", "learn", "run", "more") == {}
    for _ in range(30):  # more news than there is room for
        page.keyboard.press("w")
    begin_a_run(page, site)
    assert violations("run", "more") == {}
    # On a slow computer the robot has found the victim meanwhile.
    act(page, "End the run")
    act(page, "Really end?")
    page.click("#steps [data-panel=run]")
    page.wait_for_selector("#finish:visible")
    page.wait_for_selector("#report:visible")
    assert violations() == {}
    # It does look, in both schemes.
    run_in(page, "document.querySelector('#seat').style.color = 'var(--line)'")
    wrong = violations("run", sizes={390: SIZES[390]})
    assert len(wrong) == 2
    assert all(one == ["color-contrast: #seat"] for one in wrong.values())


@pytest.mark.usefixtures("taught_here")
def test_run_is_kidnapped_when_a_person_moves_the_robot(page: Page, site: Site) -> None:
    begin_a_run(page, site)
    before = site.poses[-1]
    route = plan_route(load_world(site.root / "worlds" / "near.json"), (before.x_m, before.y_m))
    east, north = route[1] - route[0]
    if abs(east) > abs(north):
        key = "ArrowRight" if east > 0 else "ArrowLeft"
    else:
        key = "ArrowUp" if north > 0 else "ArrowDown"

    def carry() -> None:
        page.focus("#carry")
        for one in ("Enter", *[key] * 5, "Enter"):
            page.keyboard.press(one)

    insist(page, site, carry, lambda: "kidnapped" in page.text_content("#news"))
    mine = [(one.x_m, one.y_m) for one in site.poses if one.episode == before.episode]
    assert max(map(math.dist, mine, mine[1:])) > 0.5
    act(page, "End the run")
    act(page, "Really end?")
    page.wait_for_selector("#finish .facts:has-text('kidnapped')")
    page.reload()
    page.wait_for_selector("#finish .facts:has-text('kidnapped')", timeout=60_000)


CONTROLS = """window.controls = [...document.querySelectorAll("a, button, input, select, textarea, [tabindex]")]
    .filter((one) => one.checkVisibility() && !one.disabled); controls.length"""
FOCUSED = """(() => {
    const one = document.activeElement, {outlineStyle, outlineWidth} = getComputedStyle(one);
    return [controls.indexOf(one), outlineStyle, outlineWidth];
})()"""


def test_keys_alone_reach_everything_and_drive(
    page: Page, site: Site, lost_s: Callable[[float], float]
) -> None:
    def enter() -> None:
        show(page, "Teach")
        page.focus("#drive-form [name=goal]")
        page.keyboard.press("Enter")

    insist(page, site, enter, lambda: data(page, "episode") != "")
    eventually(lambda: page.get_by_role("button", name="Found: end here").is_enabled())
    count = run_in(page, CONTROLS)
    assert count > 15
    reached = {}
    # Once round, by the browser's own controls as well.
    for _ in range(2 * count):
        page.keyboard.press("Tab")
        place, *outline = run_in(page, FOCUSED)
        reached[place] = outline
        if set(range(count)) <= set(reached):
            break
    reached.pop(-1, None)
    # What has gone meanwhile need not be reached.
    still = (
        "window.controls.map((one) => one.isConnected && one.checkVisibility() && !one.disabled)"
    )
    missing = [
        place for place, there in enumerate(run_in(page, still)) if there and place not in reached
    ]
    assert not missing, run_in(
        page, f"{missing}.map((k) => [controls[k].isConnected, controls[k].outerHTML]).join()"
    )
    assert [one for one in reached.values() if one != ["solid", "3px"]] == []
    for key, let_go in (
        ("Space", page.keyboard.up),
        ("Enter", lambda _: page.keyboard.press("Tab")),
    ):

        def press(key: str = key) -> None:
            page.keyboard.up(key)
            page.focus("#pad [data-atom=left]")
            page.keyboard.down(key)

        hold(page, site, press, "left")
        released_s = time.monotonic()
        let_go(key)
        assert site.stood_s(released_s) <= STAND_WITHIN_S + lost_s(released_s)
