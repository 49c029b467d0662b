"""Taught by one drive through a fake TurtleBot, the stack finds the victim with it."""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [
    pytest.mark.rendering,
    pytest.mark.zenoh,
    pytest.mark.system,
    pytest.mark.timeout(1500),
]


@pytest.mark.long
def test_robot_finds_the_victim_when_it_was_taught_once(near: Path, tmp_path: Path) -> None:
    """Allow three searches: a busy machine may be too slow for a real robot."""
    flags = ("--world", near, "--runs", "3", "--until-found", "--folder", tmp_path)
    command = [sys.executable, "-m", "tests.ros2.day", *flags]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "rmw_zenoh: found 1 of" in done.stdout.splitlines()[-1], done.stdout
