"""The ``smal`` command as a user runs it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.sharing import made_once

Smal = Callable[..., "subprocess.CompletedProcess[str]"]


def run_smal(*arguments: object, timeout_s: float = 500, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run ``smal`` with arguments; return what it printed."""
    return subprocess.run(
        [sys.executable, "-c", "from services.cli.main import main; main()", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
        env=os.environ | environment,
    )


@pytest.fixture(scope="session")
def smal() -> Smal:
    """Give ``run_smal``."""
    return run_smal


@pytest.fixture(scope="session")
def taught(smal: Smal, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record one drive in a small world, and learn a model from it; return their folder."""

    def make(folder: Path) -> None:
        drives = smal("demonstrate", "--world", "yard", "--seed", 1, "--camera", "160x120", "--out", folder / "drives")
        assert drives.returncode == 0, drives.stderr
        learned = smal("learn", folder / "drives", "--out", folder / "model.smal", "--json", folder / "learned.json")
        assert learned.returncode == 0, learned.stderr

    return made_once(tmp_path_factory, "taught", make)
