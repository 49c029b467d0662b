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


def test_taught_once_it_finds_the_victim(near: Path, tmp_path: Path) -> None:
    """Allow three searches: a busy machine may be too slow for a real robot."""
    command = [
        sys.executable,
        "-m",
        "tests.ros2.day",
        "--world",
        str(near),
        "--runs",
        "3",
        "--until-found",
    ]
    done = subprocess.run(
        [*command, "--folder", str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "rmw_zenoh: found 1 of" in done.stdout.splitlines()[-1], done.stdout
