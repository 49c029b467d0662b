"""Distribution of the tests over processes."""

import subprocess
import sys
from pathlib import Path

import pytest

CONFTEST = """
from tests.sharing import Sharing

def pytest_xdist_make_scheduler(config, log):
    return Sharing(config, log)
"""
QUICK = """
import pytest

@pytest.mark.parametrize("number", range(4))
def test_quick(number):
    pass
"""
CRASHING = """
import os
import signal

def test_before():
    pass

def test_crashing():
    os.kill(os.getpid(), signal.SIGKILL)

def test_after():
    pass
"""


@pytest.mark.parametrize("position", ["first", "last"])
def test_crashed_process_fails_one_test_and_the_others_run(tmp_path: Path, position: str) -> None:
    (tmp_path / "conftest.py").write_text(CONFTEST)
    for number in range(6):
        (tmp_path / f"test_{number}.py").write_text(QUICK)
    name = {"first": "test_00", "last": "test_9"}[position]
    (tmp_path / f"{name}.py").write_text(CRASHING)
    arguments = ["-q", "-n", "3", "-p", "no:cacheprovider", "--rootdir", str(tmp_path)]
    run = subprocess.run(
        [sys.executable, "-m", "pytest", *arguments, str(tmp_path)],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert run.returncode == 1, run.stdout
    assert f"{name}.py::test_crashing" in run.stdout
    assert "1 failed, 26 passed" in run.stdout
