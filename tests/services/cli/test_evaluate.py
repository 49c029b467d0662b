"""``smal evaluate`` as a user has it: a page, a second start that does nothing twice, and one line for a mistake."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from services.experiments.evaluation import plan as plans
from services.experiments.evaluation.plan import CONTROLLERS, Criterion, Plan, Trial, WorldPlan
from services.experiments.evaluation.schedule import units
from tests.services.cli.conftest import ROOT, Smal
from tests.services.waiting import eventually

TINY = Plan(
    "quick",
    (
        WorldPlan(
            "yard", (Criterion(3.0, 25.0), Criterion(1.5, 15.0)), drives=1, queries=1, lengths=(1, 5),
            recognized=("clean", "occluded"), template_frames=50,
            trials=(
                *(Trial(name, 1, 1) for name in CONTROLLERS),
                Trial("smal", 1, 1, kidnap_tick=5), Trial("nearest-1", 2, 1), Trial("paper", 1, 1, 1),
            ),
        ),
    ),
    patience=0.3,
    camera=(80, 60),
)  # fmt: skip
# The command with the tiny plan in place of the quick one.
TINY_COMMAND = """
import tests.services.cli.test_evaluate as here
from services.experiments.evaluation import plan
from services.cli.main import main
if __name__ == "__main__":
    plan.PLANS["quick"] = here.TINY
    main()
"""


def lines_of(folder: Path) -> list[str]:
    path = folder / "units.jsonl"
    return path.read_text().splitlines() if path.exists() else []


def finding_by_key(folder: Path) -> dict[str, dict[str, object]]:
    """Return what was found out, without the time that it took."""
    entries = [json.loads(line) for line in lines_of(folder)]
    return {one["key"]: {name: value for name, value in one["finding"].items() if name != "cpu_s"} for one in entries}


@pytest.mark.rendering
def test_an_evaluation_goes_on_where_it_was_interrupted(
    tmp_path: Path, smal: Smal, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(plans.PLANS, "quick", TINY)
    out = tmp_path / "evaluation"
    command = subprocess.Popen(
        [sys.executable, "-c", TINY_COMMAND, "evaluate", "--out", str(out), "--quick"],
        cwd=ROOT, stderr=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    eventually(lambda: lines_of(out) or command.poll() is not None, timeout_s=120.0)
    command.send_signal(signal.SIGINT)
    _, said = command.communicate(timeout=20.0)
    assert command.returncode == 130, said
    assert "Traceback" not in said
    before = lines_of(out)
    assert not (out / "index.html").exists()

    # What there is so far can be looked at, and nothing is done for it.
    status, printed, _ = smal("evaluate", "--out", str(out), "--quick", "--report-only")
    assert (status, printed) == (0, f"results: {out / 'index.html'}\n")
    assert f"<b>Not all is done:</b> {len(before)} of" in (out / "index.html").read_text()
    assert lines_of(out) == before

    status, printed, _ = smal("evaluate", "--out", str(out), "--quick")
    assert (status, printed) == (0, f"results: {out / 'index.html'}\n")
    after = lines_of(out)
    assert after[: len(before)] == before
    keys = [json.loads(line)["key"] for line in after]
    assert len(keys) == len(set(keys)) == len(units(TINY))
    first = json.loads((out / "results.json").read_text())

    # Nothing is left to do; and what is lost is found out again, by one worker, the same to the last digit.
    assert smal("evaluate", "--out", str(out), "--quick")[0] == 0
    assert lines_of(out) == after
    everything = finding_by_key(out)
    lost = [line for line in after if json.loads(line)["key"].startswith(("recognize", "search", "objective"))]
    (out / "units.jsonl").write_text("".join(f"{line}\n" for line in after if line not in lost[::2]))
    assert smal("evaluate", "--out", str(out), "--quick", "--workers", "1")[0] == 0
    assert finding_by_key(out) == everything
    second = json.loads((out / "results.json").read_text())
    assert second["worlds"] == first["worlds"]

    status, _, said = smal("evaluate", "--out", str(out))
    assert status == 2
    assert said.startswith(f"smal: --out {out}: holds results of the plan 'quick' (quick, now full); give another")


def test_a_file_is_no_folder_and_of_nothing_there_is_no_report(tmp_path: Path, smal: Smal) -> None:
    (tmp_path / "file").touch()
    for name, flags, said in (("file", (), "is a file, not a folder"), ("none", ("--report-only",), "no such folder")):
        status, _, line = smal("evaluate", "--out", str(tmp_path / name), *flags)
        assert (status, line.count("\n")) == (2, 1)
        assert said in line
    assert not (tmp_path / "none").exists()


def test_a_unit_that_fails_is_one_line_and_leaves_what_was_done(tmp_path: Path, smal: Smal) -> None:
    """No world of that name: the worker says so, and the command ends."""
    nowhere = Plan("quick", (WorldPlan("nowhere", (Criterion(1.0, 25.0),), trials=(Trial("smal", 1, 1),)),))
    plans_before = plans.PLANS["quick"]
    plans.PLANS["quick"] = nowhere
    try:
        status, _, said = smal("evaluate", "--out", str(tmp_path), "--quick")
    finally:
        plans.PLANS["quick"] = plans_before
    assert status == 1
    last = said.splitlines()[-1]
    assert last.startswith("smal: teach/nowhere/")
    assert "nowhere" in last.split(": ", 2)[2]
    assert "Traceback" not in said
