"""The ``smal`` command as a user runs it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

Smal = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture(scope="session")
def smal() -> Smal:
    """Run ``smal`` with arguments and return what it printed."""

    def run(*arguments: object, timeout_s: float = 500, **environment: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-c", "from services.cli.main import main; main()", *map(str, arguments)],
            capture_output=True,
            text=True,
            timeout=timeout_s,
            check=False,
            env=os.environ | environment,
        )

    return run


@pytest.fixture(scope="session")
def taught(smal: Smal, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record one drive in a small world, and learn a model from it; return their folder."""
    folder = tmp_path_factory.mktemp("taught")
    drives = smal("demonstrate", "--world", "yard", "--seed", 1, "--camera", "160x120", "--out", folder / "drives")
    assert drives.returncode == 0, drives.stderr
    learned = smal("learn", folder / "drives", "--out", folder / "model.smal", "--json", folder / "learned.json")
    assert learned.returncode == 0, learned.stderr
    return folder
