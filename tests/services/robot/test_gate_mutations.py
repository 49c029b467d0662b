"""The tests of the gate notice every small mistake in it, and take every branch of it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest

ROOT: Final = Path(__file__).parents[3]
GATE: Final = "services/robot/gate.py"
TESTS: Final = Path(__file__).with_name("test_gate.py")
_NEVER_ASSIGNED = "nothing assigns to an accepted command, and nobody outside the gate has one"
_FIRST_OF_ALL = "of the names of the sources emergency_stop is the first in the alphabet"
_NO_EPISODE = "before the first episode no command has its name"
_BY_CHANCE = "a number by chance, one bit or one more or less"
_NONE = "a function that ends without a value returns None"
#: Mutants that do what the gate does, each with the reason.
EQUIVALENT: Final = {
    "_Accepted: dataclass(frozen=True) -> dataclass()": _NEVER_ASSIGNED,
    "_Accepted: True -> False": _NEVER_ASSIGNED,
    "CommandGate.offer: command.source == 'emergency_stop' -> command.source <= 'emergency_stop'": _FIRST_OF_ALL,
    "CommandGate.__init__: 'policy' -> 'policyx'": _NO_EPISODE,
    "CommandGate.__init__: 'policy' -> ''": _NO_EPISODE,
    "_Operator: dataclass(frozen=True) -> dataclass()": _NEVER_ASSIGNED,
    "_Operator: True -> False": _NEVER_ASSIGNED,
    "CommandGate.__init__: None -> 0": "neither is the number of a stop, and one is drawn",
    "CommandGate.arm: return None -> pass": _NONE,
    "CommandGate.__init__: 48 -> 49": _BY_CHANCE,
    "CommandGate.__init__: 48 -> 47": _BY_CHANCE,
    "CommandGate.__init__: 48 -> 49 (2)": _BY_CHANCE,
    "CommandGate.__init__: 48 -> 47 (2)": _BY_CHANCE,
    "CommandGate.__init__: 1 -> 2": _BY_CHANCE,
    "CommandGate.__init__: 1 -> 0": _BY_CHANCE,
    "CommandGate.__init__: 0 -> -1": "neither is the number of a stop",
    "CommandGate.emergency_stop: self._stops != self._released -> self._stops > self._released": (
        "only the last stop is ever released"
    ),
    "CommandGate.arm: self._episode != '' -> self._episode > ''": "every name comes after the empty one",
    "CommandGate.hear: max(answered_s, last.answered_s) -> max(last.answered_s, answered_s)": "the larger of the two",
    "CommandGate.not_theirs: return None -> pass": _NONE,
    "CommandGate._check_sender: return None -> pass": _NONE,
    "CommandGate._check_sender: command.source == 'teleop' -> command.source >= 'teleop'": (
        "of the names of the sources teleop is the last in the alphabet"
    ),
    "CommandGate.applied: self._cause == 'emergency_stop' -> self._cause <= 'emergency_stop'": (
        "of the causes emergency_stop is the first in the alphabet"
    ),
    "CommandGate.offer: command.source != self._driver -> command.source > self._driver": (
        "who is not the driver is teleop here, and that is the last in the alphabet"
    ),
    "CommandGate._check_sender: ('teleop', self._driver) -> (self._driver, 'teleop')": "either is found in any order",
    "CommandGate.offer: return None -> pass (2)": _NONE,
    "CommandGate._check: command.tick < min(self._captured_s) -> command.tick <= min(self._captured_s)": (
        "the oldest frame that is remembered is found, so that this is not asked of it"
    ),
}


def run(*arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=ROOT,
        env=os.environ | variables,
        capture_output=True,
        text=True,
        check=False,
        timeout=200,
    )


def test_every_mutant_of_the_gate_is_killed(capsys: pytest.CaptureFixture[str]) -> None:
    done = run("-m", "tests.services.robot.gate_mutants")
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    survivors, killed = set(found["survivors"]), found["killed"]
    equivalent = len(survivors & EQUIVALENT.keys())
    with capsys.disabled():
        sys.stdout.write(f"\ngate: {killed + len(survivors)} mutants, {killed} killed, {equivalent} equivalent\n")
    assert survivors == EQUIVALENT.keys()
    assert killed > 200


def test_the_tests_of_the_gate_take_every_branch_of_it(tmp_path: Path) -> None:
    report = tmp_path / "coverage.json"
    place = {"COVERAGE_FILE": str(tmp_path / "coverage")}
    # The fixed examples alone: chance must not decide.
    pytest_run = ("-m", "pytest", "-q", "-k", "not Machine", "-p", "no:cacheprovider", str(TESTS))
    done = run("-m", "coverage", "run", "--branch", *pytest_run, **place)
    assert done.returncode == 0, done.stdout + done.stderr
    done = run("-m", "coverage", "json", f"--include={GATE}", "-o", str(report), **place)
    assert done.returncode == 0, done.stdout + done.stderr
    gate = json.loads(report.read_text())["files"][GATE]
    assert gate["summary"]["num_branches"] > 20
    assert (gate["missing_lines"], gate["missing_branches"], gate["excluded_lines"]) == ([], [], [])
