"""The page in a real browser, on the real stack: what a person clicks and presses, and what becomes of the robot."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from schemas import topics
from schemas.codec import decode
from schemas.command import CommandApplied
from schemas.pose import Pose
from schemas.rpc import Nothing, Status
from services.cli.stack.processes import Stack, StackPlan, flags, free_endpoint
from services.expert.driver import RouteDriver
from services.kit.bus import Bus, RpcError
from services.robot.loop import STAND_WITHIN_S
from services.simulator.world import load_world
from services.simulator.world.loading import WORLDS_FOLDER
from services.simulator.world.route import plan_route
from services.table import stack_services
from tests.benchmarks.faults.proxy import link
from tests.benchmarks.soak.page import held, judge_page
from tests.services.waiting import eventually, status_of

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = [pytest.mark.system, pytest.mark.rendering, pytest.mark.zenoh]
KEYS = {"forward": "w", "left": "a", "right": "d", "backward": "s"}
SPEED_M_S = 2.0
#: Teach, learn, run, found.
WHOLE_LOOP_S = 240.0


class Site:
    """A stack with its page, and what the robot really does."""

    def __init__(self, address: str, stack: Stack, bus: Bus, root: Path) -> None:
        self.address = address
        self.stack = stack
        self.bus = bus
        self.root = root
        self.poses: list[Pose] = []
        #: What moved the robot, since when.
        self.applied: list[tuple[float, CommandApplied]] = []
        bus.subscribe(topics.POSE, lambda payload, encoding, _: self.poses.append(decode(Pose, payload, encoding)))
        bus.subscribe(topics.APPLIED, self._note)

    def _note(self, payload: bytes, encoding: str, _transit_s: float | None) -> None:
        self.applied.append((time.monotonic(), decode(CommandApplied, payload, encoding)))

    @property
    def drives(self) -> bool:
        """Whether the robot is being moved."""
        return bool(self.applied) and self.applied[-1][1].atom != "stop"

    def stood_s(self, since_s: float) -> float:
        """Wait until the actuator stands; return how long after a time it was last told to move."""
        eventually(lambda: not self.drives)
        return max((at for at, one in self.applied if one.atom != "stop"), default=since_s) - since_s

    def pid_of_console(self) -> int:
        """Wait until the console answers; return its process id."""
        status = eventually(lambda: status_of(self.bus, "console"), timeout_s=30.0)
        assert status is not None
        return status.pid

    def robot(self, key: str) -> object:
        """Return what the robot tells of itself."""
        with suppress(RpcError):
            return self.bus.call("robot", "status", Nothing(), Status).detail[key]
        return None


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """Start a stack on the world ``yard``."""
    root, endpoint = tmp_path_factory.mktemp("root"), free_endpoint()
    address = free_endpoint().removeprefix("tcp/")
    below = flags(root=root)
    own = {
        "robot": flags(world="yard", camera_width=320, camera_height=240) + below,
        **dict.fromkeys(("recognition", "policy", "recorder"), below),
        "console": flags(console=address) + below,
    }
    plan = StackPlan(stack_services(), "rescuebot", endpoint, own, logs=root / "logs")
    with Stack(plan) as stack, closing(Bus("rescuebot", endpoint)) as bus:
        yield Site(address, stack, bus, root)


@pytest.fixture
def page(browser: Browser, site: Site) -> Iterator[Page]:
    """Open the page."""
    with opened(browser, site) as page:
        yield page


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
            sys.stdout.write("\n".join(page.inner_text(part) for part in ("#status", "#job", "#news")) + "\n")
        context.close()
    assert errors == []


def told(page: Page) -> str:
    """Return the line that says how the robot is."""
    return page.inner_text("#status")


def data(page: Page, name: str) -> str:
    """Return what the page notes of the episode."""
    return page.get_attribute("body", f"data-{name}") or ""


def begin_a_drive(page: Page, site: Site) -> None:
    before = data(page, "episode")
    insist(page, site, lambda: page.click("#drive-form button"), lambda: data(page, "episode") not in ("", before))
    # Pressed twice, it has begun two, and the page follows.
    eventually(lambda: site.poses and site.poses[-1].episode == data(page, "episode"))


def drive_ahead(page: Page, site: Site) -> None:
    """Begin a drive, and hold the key for ahead."""
    begin_a_drive(page, site)
    hold(page, site, lambda: page.keyboard.down("w"))


def insist(page: Page, site: Site, press: Callable[[], None], done: Callable[[], object]) -> None:
    """Press something until it is done: a busy machine loses the robot's operator meanwhile, and refuses."""
    press()

    def is_done() -> object:
        if was_lost(page, site):
            press()
        return done()

    eventually(is_done, timeout_s=60.0)


def hold(page: Page, site: Site, press: Callable[[], None], atom: str = "forward") -> None:
    """Press something until the robot moves by it."""
    insist(page, site, press, lambda: site.drives and site.applied[-1][1].atom == atom)


def was_lost(page: Page, site: Site) -> bool:
    """Arm a robot that had lost its operator, since the machine was busy elsewhere; a person would go on as well."""
    if site.robot("stop_cause") != "operator_lost":
        return False
    for key in KEYS.values():
        page.keyboard.up(key)

    def armed() -> bool:
        page.click("#resume")
        with suppress(pytest.fail.Exception):
            return eventually(lambda: site.robot("stop_cause") is None, timeout_s=2.0)
        return False  # it was lost once more meanwhile

    return eventually(armed, timeout_s=60.0)


def drive_to_the_victim(page: Page, site: Site) -> None:
    """Drive by keys, as the scripted expert would."""
    world, here = load_world("yard"), site.poses[-1]
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
        eventually(lambda seen=here: site.poses[-1] is not seen)  # type: ignore[misc]
        here = site.poses[-1]
    page.keyboard.up(held)


def test_teach_once_learn_run_found(page: Page, site: Site) -> None:
    """By clicks and keys alone; what is compiled is compiled before, as it is when SMAL is set up."""
    subprocess.run(
        [sys.executable, "-c", "from smal.paper.matching.streaming import compile_ahead; compile_ahead()"], check=True
    )
    began_s = time.monotonic()
    begin_a_drive(page, site)
    eventually(lambda: page.is_visible("#map .victim"))
    drive_to_the_victim(page, site)
    page.click("#found")
    eventually(lambda: data(page, "outcome") == "found")
    eventually(lambda: page.locator("#recordings input:checked").count() == 1, timeout_s=20.0)
    page.click("#learn-form button:not([type])")
    eventually(lambda: "way-1 is learned" in page.inner_text("#job"), timeout_s=WHOLE_LOOP_S)
    eventually(lambda: page.locator("#run-form select[name=model] option").count() == 1)
    insist(page, site, lambda: page.click("#run-form button"), lambda: data(page, "episode").startswith("run"))
    eventually(lambda: page.locator("#belief img").get_attribute("src"), timeout_s=30.0)
    eventually(lambda: not was_lost(page, site) and data(page, "episode") == "", timeout_s=120.0)
    assert data(page, "outcome") == "found"
    assert time.monotonic() - began_s <= WHOLE_LOOP_S
    assert run_in(page, "document.querySelector('#belief img').naturalWidth") == 320


def run_in(page: Page, script: str) -> Any:
    """Run a script as the developer's tools do; the page's own policy forbids what Playwright would do."""
    tools = page.context.new_cdp_session(page)
    asked = {"expression": script, "awaitPromise": True, "returnByValue": True}
    answer = tools.send("Runtime.evaluate", asked)
    assert "exceptionDetails" not in answer, answer
    tools.detach()
    return answer["result"].get("value")


def reload(page: Page) -> None:
    run_in(page, "location.reload()")


def close(page: Page) -> None:
    page.close()


def hide(page: Page) -> None:
    """Have another tab come to the front, which a browser without a window does not do by itself."""
    run_in(page, "Object.defineProperty(document, 'hidden', {value: true})")
    run_in(page, "document.dispatchEvent(new Event('visibilitychange'))")


def lose_focus(page: Page) -> None:
    run_in(page, "window.dispatchEvent(new Event('blur'))")


def open_a_menu(page: Page) -> None:
    """While it is open, the page hears of no key that is let go; nor while something is dragged, nor with Meta."""
    run_in(page, "document.body.dispatchEvent(new Event('contextmenu', {bubbles: true}))")


def drag_something(page: Page) -> None:
    run_in(page, "document.body.dispatchEvent(new Event('dragstart', {bubbles: true}))")


def press_command(page: Page) -> None:
    page.keyboard.down("Meta")


def stop_by_gamepad(page: Page) -> None:
    run_in(page, "navigator.getGamepads = () => [null, {buttons: [{}, {pressed: true}], axes: [0, 0]}]")


def press_escape(page: Page) -> None:
    page.keyboard.press("Escape")


def press_the_red_button(page: Page) -> None:
    page.click("#stop")


@pytest.mark.parametrize(
    "what",
    [
        reload,
        close,
        hide,
        lose_focus,
        open_a_menu,
        drag_something,
        press_command,
        stop_by_gamepad,
        press_escape,
        press_the_red_button,
    ],
    ids=lambda what: what.__name__,
)
def test_whatever_becomes_of_the_page_the_robot_stands(
    browser: Browser, site: Site, what: Callable[[Page], None]
) -> None:
    with opened(browser, site) as page:
        drive_ahead(page, site)
        # Chromium takes its time for some of these: the robot is watched meanwhile, on a thread of the bus.
        began_s = time.monotonic()
        what(page)
        took_s = time.monotonic() - began_s
        assert site.stood_s(began_s) <= took_s + STAND_WITHIN_S
        if what in (stop_by_gamepad, press_escape, press_the_red_button):
            eventually(lambda: site.robot("stop_cause") == "emergency_stop")


def processes_of(name: str) -> list[int]:
    """Return the processes of a name that this one's children have started."""
    parents, named = {}, []
    for entry in Path("/proc").iterdir():
        with suppress(OSError, ValueError):
            _, _, rest = (entry / "stat").read_text().rpartition(") ")
            parents[int(entry.name)] = int(rest.split()[1])
            if name in (entry / "cmdline").read_text():
                named.append(int(entry.name))

    def is_ours(pid: int) -> bool:
        return pid == os.getpid() or (pid in parents and is_ours(parents[pid]))

    return [pid for pid in named if is_ours(pid)]


def test_a_laptop_that_falls_asleep_leaves_the_robot_standing(page: Page, site: Site) -> None:
    drive_ahead(page, site)
    laptop = processes_of("chromium")
    assert laptop
    try:
        asleep_s = time.monotonic()
        for pid in laptop:
            os.kill(pid, signal.SIGSTOP)
        assert site.stood_s(asleep_s) <= STAND_WITHIN_S
        eventually(lambda: site.robot("stop_cause") == "operator_lost")
    finally:
        for pid in laptop:
            os.kill(pid, signal.SIGCONT)
    # The key is still down. What was under way is late, and what comes then finds a robot that has to be armed.
    eventually(lambda: "lost its operator" in told(page))
    said = len(site.applied)
    eventually(lambda: len(site.applied) > said + 10)
    assert not site.drives
    page.keyboard.up("w")
    page.click("#resume")
    eventually(lambda: site.robot("stop_cause") is None)


def test_a_second_tab_watches_and_stops_but_does_not_drive(browser: Browser, site: Site, page: Page) -> None:
    drive_ahead(page, site)
    with opened(browser, site) as other:
        eventually(lambda: other.inner_text("#seat") == "Somebody else drives")
        other.click("#seat")
        eventually(lambda: "Somebody else drives; you watch." in other.inner_text("#news"))
        other.keyboard.down("s")
        # The first page may have lost its focus to this one, and the robot stands; it never drives backward.
        page.keyboard.up("w")
        hold(page, site, lambda: page.keyboard.down("w"))
        assert "backward" not in {one.atom for _, one in site.applied}
        other.keyboard.press("Escape")
        pressed_s = time.monotonic()
        assert site.stood_s(pressed_s) <= STAND_WITHIN_S
        eventually(lambda: "EMERGENCY STOP" in told(page))
    page.keyboard.up("w")
    page.click("#resume")
    eventually(lambda: "EMERGENCY STOP" not in told(page))


def test_the_pad_drives_while_it_is_held(page: Page, site: Site) -> None:
    begin_a_drive(page, site)

    def press() -> None:
        page.mouse.up()
        page.hover("#pad [data-atom=left]")
        page.mouse.down()

    hold(page, site, press, "left")
    released_s = time.monotonic()
    page.mouse.up()
    assert site.stood_s(released_s) <= STAND_WITHIN_S


def test_a_hostile_name_is_shown_as_it_is(page: Page, site: Site) -> None:
    """The page's own policy would stop a script; but there is no markup to begin with."""
    name = "<img src=x onerror=alert(1)>"
    page.fill("#drive-form input", name)
    page.click("#drive-form button")
    eventually(lambda: "goal: a name has 1 to 64 letters" in page.inner_text("#news"))
    assert page.locator("#news img").count() == 0


def test_the_paper_s_scheme_drives_when_it_is_learned(page: Page, site: Site) -> None:
    """By what was driven in the first of these tests."""
    if page.locator("#run-form select[name=model] option").count() == 0:
        pytest.skip("nothing is learned: run the whole file")
    page.fill("#learn-form [name=name]", "states")
    page.select_option("#learn-form [name=scheme]", "paper")
    page.click("#learn-form button:not([type])")
    eventually(lambda: "states is learned" in page.inner_text("#job"), timeout_s=WHOLE_LOOP_S)
    model = page.locator("#run-form [name=model]")
    eventually(lambda: model.locator("option").count() == 2)
    model.select_option("models/states.smal")
    assert page.is_disabled("#run-form [name=goal]"), "it goes to the nearest"
    by_itself = lambda: site.drives and site.applied[-1][1].source == "policy"  # noqa: E731
    insist(page, site, lambda: page.click("#run-form button"), by_itself)
    for service in ("recognition", "policy"):
        assert site.bus.call(service, "status", Nothing(), Status).detail["scheme"] == "paper"
    page.click("#end")
    eventually(lambda: data(page, "episode") == "")


def drop(page: Page, file: Path, name: str) -> None:
    """Drop a file on the map, as from a folder's window."""
    run_in(page, "var dropped = new DataTransfer()")
    run_in(page, f"dropped.items.add(new File([{json.dumps(file.read_text())}], {json.dumps(name)}))")
    event = "new DragEvent('drop', {dataTransfer: dropped, bubbles: true, cancelable: true})"
    run_in(page, f"document.querySelector('#map').dispatchEvent({event})")


def test_a_map_that_is_dropped_is_a_world_to_drive_in(page: Page, site: Site) -> None:
    drop(page, WORLDS_FOLDER / "yard.osm", "My town!.osm")
    world = page.locator("#world-form [name=world]")
    eventually(lambda: world.input_value() == "My town-", timeout_s=60.0)
    page.select_option("#world-form [name=variation]", "dark")
    page.fill("#drive-form [name=name]", "By night")
    begin_a_drive(page, site)
    assert data(page, "episode").startswith("by-night-")
    eventually(lambda: "in My town-" in page.inner_text("#episode"))
    assert site.robot("variation") == "dark"
    page.click("#end")
    eventually(lambda: data(page, "episode") == "")
    drop(page, WORLDS_FOLDER / "indoor.json", "no map.osm")
    eventually(lambda: "Making a world of no map failed: no map.osm: not a readable" in page.inner_text("#job"), 60.0)


# -- who sees and how --------------------------------------------------------------------------------------------------


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
    eventually(lambda: page.locator("#world-form option[value=yard]").count() == 1)
    page.select_option("#world-form [name=world]", "yard")
    eventually(lambda: page.locator(f"#run-form option[value='{name}']").count() == 1)
    page.select_option("#run-form select[name=model]", name)
    insist(page, site, lambda: page.click("#run-form button"), lambda: data(page, "episode").startswith("run"))
    eventually(lambda: page.locator("#belief img").get_attribute("src"), timeout_s=30.0)


def look(page: Page, frames: int) -> None:
    """Look on while so many frames of the robot pass."""

    def frame() -> int:
        _, _, text = page.inner_text("#episode").partition("frame ")
        return int(text.split(",")[0] or 0)

    until = frame() + frames
    eventually(lambda: frame() >= until, timeout_s=30.0)


SIZES = {1440: 1000, 1024: 900, 390: 844}
# Of the results of a run of axe-core those that are wrong, with the elements that they are about.
VIOLATIONS = """axe.run({resultTypes: ["violations"]}).then(({violations}) => violations.map(
    ({id, nodes}) => `${id}: ${nodes.map(({target}) => target.join(" ")).join(", ")}`))"""


@pytest.mark.usefixtures("taught_here")
def test_axe_core_finds_nothing(page: Page, site: Site) -> None:
    axe = pytest.importorskip("axe_playwright_python.base", reason="axe-playwright-python is not installed")
    run_in(page, f"{axe.AXE_SCRIPT}; 0")

    def violations() -> dict[tuple[str, int], list[str]]:
        found = {}
        for scheme in ("light", "dark"):
            page.emulate_media(color_scheme=scheme)  # type: ignore[arg-type]
            for width, height in SIZES.items():
                page.set_viewport_size({"width": width, "height": height})
                found[scheme, width] = run_in(page, VIOLATIONS)
        page.set_viewport_size({"width": 1440, "height": SIZES[1440]})
        return {where: wrong for where, wrong in found.items() if wrong}

    assert violations() == {}
    for _ in range(30):  # more news than there is room for
        page.keyboard.press("w")
    begin_a_run(page, site)
    assert violations() == {}
    # It does look, and in all of them.
    run_in(page, "document.querySelector('#resume').style.color = 'var(--line)'")
    wrong = violations()
    assert len(wrong) == 2 * len(SIZES)
    assert all(one == ["color-contrast: #resume"] for one in wrong.values())


SHIFTS = """window.shifted = 0; new PerformanceObserver((list) => {
    for (const one of list.getEntries()) if (!one.hadRecentInput) shifted += one.value;
}).observe({type: "layout-shift", buffered: true})"""
#: What counts as good; Google's Web Vitals.
MOST_SHIFT = 0.1


@pytest.mark.usefixtures("taught_here")
def test_nothing_moves_below_the_eyes(page: Page, site: Site) -> None:
    def shifted() -> float:
        return float(run_in(page, "shifted"))

    run_in(page, SHIFTS)
    begin_a_run(page, site)
    assert shifted() < MOST_SHIFT
    for width, height in SIZES.items():
        page.set_viewport_size({"width": width, "height": height})
        run_in(page, "document.querySelector('#belief').scrollIntoView(); shifted = 0")
        look(page, 10)
        assert shifted() < MOST_SHIFT
    run_in(page, "scrollTo(0, 0); document.querySelector('main').prepend(document.createElement('canvas'))")
    eventually(lambda: shifted() >= MOST_SHIFT)


CONTROLS = """window.controls = [...document.querySelectorAll("a, button, input, select, textarea, [tabindex]")]
    .filter((one) => one.checkVisibility() && !one.disabled); controls.length"""
FOCUSED = """(() => {
    const one = document.activeElement, {outlineStyle, outlineWidth} = getComputedStyle(one);
    return [controls.indexOf(one), outlineStyle, outlineWidth];
})()"""


def test_keys_alone_reach_everything_and_drive(page: Page, site: Site) -> None:

    def enter() -> None:
        page.focus("#drive-form [name=goal]")
        page.keyboard.press("Enter")

    insist(page, site, enter, lambda: data(page, "episode") != "")
    eventually(lambda: page.locator("#found").is_enabled())
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
    still = "window.controls.map((one) => one.isConnected && one.checkVisibility() && !one.disabled)"
    missing = [place for place, there in enumerate(run_in(page, still)) if there and place not in reached]
    assert not missing, run_in(page, f"{missing}.map((k) => [controls[k].isConnected, controls[k].outerHTML]).join()")
    assert [one for one in reached.values() if one != ["solid", "3px"]] == []
    for key, let_go in (("Space", page.keyboard.up), ("Enter", lambda _: page.keyboard.press("Tab"))):

        def press(key: str = key) -> None:
            page.keyboard.up(key)
            page.focus("#pad [data-atom=left]")
            page.keyboard.down(key)

        hold(page, site, press, "left")
        released_s = time.monotonic()
        let_go(key)
        assert site.stood_s(released_s) <= STAND_WITHIN_S


# Keeps every picture, ten nodes and a listener for each.
LEAK = """(() => {
    const kept = [], draw = createImageBitmap;
    window.createImageBitmap = async (blob) => {
        const node = document.createElement("p");
        node.append(...Array.from({length: 9}, () => document.createElement("p")));
        kept.push(await blob.arrayBuffer(), node);
        addEventListener("resize", () => node);
        return draw(blob);
    };
})()"""


@pytest.mark.usefixtures("taught_here")
def test_a_page_that_watches_does_not_grow(page: Page, site: Site) -> None:
    """For ten minutes: ``smal bench soak --page``."""
    begin_a_run(page, site)
    begin_a_drive(page, site)
    tools = page.context.new_cdp_session(page)
    look(page, 20)
    first = held(0.0, tools.send)
    look(page, 70)
    then = held(1.0, tools.send)
    assert judge_page([first, then])[""] == "met"
    run_in(page, LEAK)
    eventually(
        lambda: judge_page([then, held(2.0, tools.send)])[""] == "NOT MET: memory, nodes, listeners", timeout_s=30.0
    )


# -- faults ------------------------------------------------------------------------------------------------------------


@contextmanager
def killed(site: Site, _link: int) -> Iterator[None]:
    """Kill the console; whoever looks after the stack starts it again."""
    os.kill(site.pid_of_console(), signal.SIGKILL)
    try:
        yield
    finally:
        eventually(lambda: "console" in site.stack.restart_dead())
        site.pid_of_console()


@contextmanager
def frozen(pid: int) -> Iterator[None]:
    os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(pid, signal.SIGCONT)


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        (killed, "No connection to the console for"),
        (lambda site, _: frozen(site.pid_of_console()), "No word from the console for"),
        (lambda _, link: frozen(link), "No word from the console for"),
    ],
    ids=["the console is killed", "the console is frozen", "the link is cut"],
)
def test_without_its_console_the_robot_stands_until_somebody_asks(
    browser: Browser, site: Site, fault: Callable[[Site, int], AbstractContextManager[None]], says: str
) -> None:
    with link(f"tcp/{site.address}") as (by, link_pid), opened(browser, site, by.removeprefix("tcp/")) as page:
        drive_ahead(page, site)
        began_s = time.monotonic()
        with fault(site, link_pid):
            assert site.stood_s(began_s) <= STAND_WITHIN_S
            eventually(lambda: told(page).startswith(says))
        # The key is still down.
        eventually(lambda: "the console" not in told(page))
        said = len(site.applied)
        eventually(lambda: len(site.applied) > said + 10)
        assert not site.drives
        assert site.robot("stop_cause") is not None
        page.keyboard.up("w")
        page.click("#resume")
        eventually(lambda: site.robot("stop_cause") is None)
        hold(page, site, lambda: page.keyboard.down("w"))


def test_a_stop_that_may_not_arrive_is_said(page: Page, site: Site) -> None:
    with frozen(site.pid_of_console()):
        eventually(lambda: told(page).startswith("No word from the console for"))
        page.keyboard.press("Escape")
        eventually(lambda: "The console does not answer: the emergency stop may be late." in page.inner_text("#news"))
    eventually(lambda: "EMERGENCY STOP" in told(page))
    page.click("#resume")
    eventually(lambda: site.robot("stop_cause") is None)
