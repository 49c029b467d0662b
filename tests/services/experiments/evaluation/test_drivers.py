"""Drivers by name: the protocol's example drives, and a bad driver is one line with its name."""

import math
import re
import sys
from pathlib import Path

import pytest

from services.experiments.evaluation.drivers import (
    CheckedDriver,
    DriverError,
    code_of,
    driver_entry,
)
from services.experiments.evaluation.plan import CELLS, PLANS, comparison
from services.experiments.evaluation.units import Searches, units
from services.kit.errors import UsageError
from tests.smal.evaluation.wood import Wood

PROTOCOL = (Path(__file__).parents[4] / "services" / "experiments" / "PROTOCOL.md").read_text()
BAD = """
import math

class Bad:
    said = place = None

    def __init__(self, drives, folder):
        pass

    def reset(self, seed):
        pass

    def step(self, image, odometry, depth, elapsed_s):
        print("a print of a driver")
        return ANSWER

    def says(self, **what):
        vars(self).update(what)
        return 0.0, 0.0
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_example_of_the_protocol_repeats_a_drive(folder: Path) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", PROTOCOL, re.DOTALL)
    (folder / "protocol_example.py").write_text(code)
    wood = Wood(1)
    driver = CheckedDriver("protocol_example:ByWheels", [wood.drive], folder)
    poses = wood.repeat(driver, (0.0, 0.0, 0.0), 300)
    assert driver.said == "found"
    assert math.dist(poses[-1, :2], wood.way[-1, :2]) < 0.5
    assert code_of("protocol_example:ByWheels") != code_of("smal") == ""


def test_digest_of_a_driver_changes_with_its_helpers(folder: Path) -> None:
    (folder / "helpers").mkdir()
    (folder / "helped_driver.py").write_text("import math\nfrom helpers.near import Mine\n")
    (folder / "helpers" / "near.py").write_text("from .far import X\nclass Mine: ...\n")
    (folder / "helpers" / "far.py").write_text("X = 1\n")
    (folder / "unrelated.py").write_text("")
    before = code_of("helped_driver:Mine")
    (folder / "unrelated.py").write_text("Y = 1\n")
    assert code_of("helped_driver:Mine") == before
    (folder / "helpers" / "far.py").write_text("X = 2\n")
    assert code_of("helped_driver:Mine") != before


def test_protocol_fits_a_page_and_names_every_cell() -> None:
    assert len([word for word in PROTOCOL.split() if word.strip("|-")]) <= 800
    assert re.findall(r"^\| `([a-z-]+)` \|", PROTOCOL, re.MULTILINE)[-len(CELLS) :] == [*CELLS]


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("smul", "driver 'smul' not found; choose from smal, teach-and-repeat"),
        ("nowhere_here:A", "driver nowhere_here:A: module 'nowhere_here' not found in "),
        ("math:Nothing", "driver math:Nothing: 'Nothing' not found in the module math"),
        ("math:pi", "driver math:pi: 'pi' is no class; it must take the drives"),
        ("driver.py:A", "driver driver.py:A: give the module without .py: driver:A"),
        ("../driver:A", "driver '../driver:A' not found; choose from smal, "),
        ("ending_driver:A", "driver ending_driver:A: SystemExit: 3"),
        ("broken_driver:A", "driver broken_driver:A: ZeroDivisionError: division by zero"),
    ],
)
def test_driver_is_refused_by_name(folder: Path, name: str, line: str) -> None:
    (folder / "broken_driver.py").write_text("1 / 0")
    (folder / "ending_driver.py").write_text("raise SystemExit(3)")
    with pytest.raises(UsageError, match=f"^{re.escape(line)}"):
        driver_entry(name)


@pytest.mark.parametrize(
    ("answer", "line"),
    [
        ("float('nan'), 0.0", "the result of step must be two numbers of -1 to 1, got (nan, 0.0)"),
        ("(1.0, 0.0, 0.0)", "the result of step must be two numbers of -1 to 1, got (1.0, 0.0, 0"),
        ("None", "the result of step must be two numbers of -1 to 1, got None"),
        ("drives", "step failed: NameError: name 'drives' is not defined (bad_driver.py, line "),
        ("exit(3)", "step failed: SystemExit: 3"),
        ("self.says(said='lost')", "said must be None, 'found' or 'not_here', got 'lost'"),
        ("self.says(said=[1, 2])", "said must be None, 'found' or 'not_here', got [1, 2]"),
        ("self.says(place=(95, 0, 0, 0))", "place must be None or (frame 0 to 94, ahead, left, "),
        ("self.says(place=(-1, 0, 0, 0))", "place must be None or (frame 0 to 94, ahead, left, "),
        ("self.says(place=(math.inf, 0, 0, 0))", "place must be None or (frame 0 to 94, ahead, "),
    ],
)
def test_nonsense_of_a_driver_is_one_line(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    answer: str,
    line: str,
) -> None:
    monkeypatch.delitem(sys.modules, "bad_driver", raising=False)
    (folder / "bad_driver.py").write_text(BAD.replace("ANSWER", answer))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    wood = Wood(1)
    driver = CheckedDriver("bad_driver:Bad", [wood.drive], folder)
    driver.reset(0)
    with pytest.raises(DriverError, match=f"^driver bad_driver:Bad: {re.escape(line)}") as raised:
        step_once(driver, wood)
    assert "\n" not in str(raised.value)
    assert capsys.readouterr().out == ""  # Standard output belongs to the results.


def step_once(driver: CheckedDriver, wood: Wood) -> tuple[object, object]:
    """Ask for everything that a search asks for after an image."""
    driver.step(wood.seen(wood.way[0]), (0.0, 0.0, 0.0), None, 0.1)
    return driver.place, driver.said


def test_comparison_teaches_each_driver_once_for_all_cells() -> None:
    plan = comparison(PLANS["quick"], ("smal", "place-filter"), ("start", "kidnapped"), 50)
    planned = units(plan)
    searches = [unit for unit in planned if isinstance(unit, Searches)]
    assert {(one.trial.driver, one.trial.cell) for one in searches} == {
        (driver, cell) for driver in ("smal", "place-filter") for cell in ("start", "kidnapped")
    }
    kinds = [type(unit).__name__ for unit in planned]
    assert (kinds.count("Teach"), kinds.count("TeachDriver"), len(searches)) == (5, 10, 20)
    with pytest.raises(UsageError, match="cell 'dark' not found; choose from start,"):
        comparison(PLANS["quick"], ("smal",), ("dark",), 50)
