"""``smal evaluate`` as a user has it: a page, a second start that does nothing twice."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from services.experiments.evaluation import plan as plans
from services.experiments.evaluation.plan import Criterion, EvaluationPlan, Trial, WorldPlan
from services.experiments.evaluation.units import units
from tests.services.cli.conftest import ROOT, Smal
from tests.services.waiting import DEADLINE_S, eventually

# The command with the tiny plan, in the first argument's world, in place of the quick one.
TINY_COMMAND = """
import sys
import tests.services.cli.test_evaluate as here
from services.experiments.evaluation import plan
from services.cli.main import main
if __name__ == "__main__":
    plan.PLANS["quick"] = here.tiny(sys.argv.pop(1))
    main()
"""


def tiny(world: str) -> EvaluationPlan:
    """Return a plan of three units."""
    trials = Trial("teach-and-repeat", 1, 1), Trial("teach-and-repeat", 1, 1, start="anywhere")
    small = WorldPlan(world, Criterion(3.0, 25.0), trials=trials)
    return EvaluationPlan("quick", (small,), patience=0.1, camera=(80, 60))


def done_in(folder: Path) -> dict[str, dict[str, object]]:
    """Return what was found out by file, without the time that it took."""
    entries = {
        path.name: json.loads(path.read_text())["finding"]
        for path in (folder / "units").glob("*.json")
    }
    return {
        name: {key: value for key, value in one.items() if key not in ("cpu_s", "decision_ms")}
        for name, one in entries.items()
    }


@pytest.mark.long
@pytest.mark.rendering
@pytest.mark.timeout(1200)
def test_an_evaluation_goes_on_where_it_was_interrupted(
    near: Path, tmp_path: Path, smal: Smal, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(plans.PLANS, "quick", tiny(str(near)))
    out = tmp_path / "evaluation"
    command = subprocess.Popen(
        [sys.executable, "-c", TINY_COMMAND, str(near), "evaluate", "--out", str(out), "--quick", "--workers", "1"],
        cwd=ROOT, stderr=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    eventually(lambda: len(done_in(out)) > 1 or command.poll() is not None, timeout_s=DEADLINE_S)
    command.send_signal(signal.SIGINT)
    _, said = command.communicate(timeout=DEADLINE_S)
    assert command.returncode == 130, said
    assert "Traceback" not in said
    before = done_in(out)
    assert not (out / "index.html").exists()

    # What is lost is found out again, by another worker, the same to the last digit; the rest is left alone.
    lost, *kept = sorted((out / "units").glob("*.json"))
    lost.unlink()
    times = {path: path.stat().st_mtime_ns for path in kept}
    status, printed, _ = smal("evaluate", "--out", str(out), "--quick", "--workers", "1")
    assert (status, printed) == (0, f"results: {out / 'index.html'}\n")
    after = done_in(out)
    assert len(after) == len(units(tiny(str(near))))
    assert before.items() <= after.items()
    assert {path: path.stat().st_mtime_ns for path in times} == times


def test_evaluate_keeps_results_when_a_unit_fails(
    tmp_path: Path, smal: Smal, monkeypatch: pytest.MonkeyPatch
) -> None:
    nowhere = EvaluationPlan(
        "quick", (WorldPlan("nowhere", Criterion(1.0, 25.0), trials=(Trial("smal", 1, 1),)),)
    )
    monkeypatch.setitem(plans.PLANS, "quick", nowhere)
    status, _, said = smal("evaluate", "--out", str(tmp_path), "--quick", "--workers", "1")
    assert status == 1
    last = said.splitlines()[-1]
    assert last.startswith("smal: teach in nowhere: ")
    assert "Traceback" not in said


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (("--driver", "nowhere_here:A"), "driver nowhere_here:A: module 'nowhere_here' not found"),
        (("--drivers", "smul"), "driver 'smul' not found; choose from smal, "),
        (("--cells", "dark"), "cell 'dark' not found; choose from start, "),
    ],
)
def test_evaluate_names_an_unknown_driver_or_cell(
    tmp_path: Path, smal: Smal, options: tuple[str, str], line: str
) -> None:
    status, _, said = smal("evaluate", "--out", str(tmp_path), *options)
    assert status == 2
    assert said.startswith(f"smal: {line}")
    assert said.count("\n") == 1
