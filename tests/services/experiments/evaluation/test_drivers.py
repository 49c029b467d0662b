"""Drivers by name: the protocol's example drives, and a bad driver is one line with its name."""

import math
import re
from pathlib import Path

import pytest

from services.experiments.evaluation.drivers import CheckedDriver, code_of, driver_entry
from services.experiments.evaluation.plan import CELLS, PLANS, comparison
from services.experiments.evaluation.units import Searches, units
from services.kit.errors import JobError, UsageError
from tests.smal.evaluation.wood import Wood

PROTOCOL = (Path(__file__).parents[4] / "services" / "experiments" / "PROTOCOL.md").read_text()
BAD = """
class Bad:
    said = place = None

    def __init__(self, drives, folder):
        pass

    def reset(self, seed):
        pass

    def step(self, image, odometry, depth, elapsed_s):
        return ANSWER
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


def test_protocol_fits_a_page_and_names_every_cell() -> None:
    assert len([word for word in PROTOCOL.split() if word.strip("|-")]) <= 600
    assert re.findall(r"^\| `([a-z-]+)` \|", PROTOCOL, re.MULTILINE)[-len(CELLS) :] == [*CELLS]


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("smul", "driver 'smul' not found; choose from smal, teach-and-repeat"),
        ("nowhere_here:A", "driver nowhere_here:A: module 'nowhere_here' not found in "),
        ("math:Nothing", "driver math:Nothing: 'Nothing' not found in the module math"),
        ("math:pi", "driver math:pi: 'pi' is no class; it must take the drives"),
        ("broken_driver:A", "driver broken_driver:A: ZeroDivisionError: division by zero"),
    ],
)
def test_driver_is_refused_by_name(folder: Path, name: str, line: str) -> None:
    (folder / "broken_driver.py").write_text("1 / 0")
    with pytest.raises(UsageError, match=f"^{re.escape(line)}"):
        driver_entry(name)


@pytest.mark.parametrize(
    ("answer", "line"),
    [
        ("float('nan'), 0.0", "the result of step must be two numbers of -1 to 1, got (nan, 0.0)"),
        ("(1.0, 0.0, 0.0)", "the result of step must be two numbers of -1 to 1, got (1.0, 0.0, 0"),
        ("None", "the result of step must be two numbers of -1 to 1, got None"),
        ("drives", "step failed: NameError: name 'drives' is not defined"),
    ],
)
def test_nonsense_of_a_driver_is_one_line(folder: Path, answer: str, line: str) -> None:
    module = f"bad_{abs(hash(answer))}"
    (folder / f"{module}.py").write_text(BAD.replace("ANSWER", answer))
    wood = Wood(1)
    driver = CheckedDriver(f"{module}:Bad", [wood.drive], folder)
    with pytest.raises(JobError, match=f"^driver {module}:Bad: {re.escape(line)}"):
        wood.repeat(driver, (0.0, 0.0, 0.0), 3)


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
