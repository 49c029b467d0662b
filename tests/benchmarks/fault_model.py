"""A model of a small world, for a robot that is to drive by itself while it is disturbed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Final

from services.commands.child import tied
from services.commands.errors import JobError
from tests.benchmarks.fault_rig import CAMERA, WORLD

_SMAL: Final = "from services.cli import main; main()"


def taught_model(folder: Path) -> Path:
    """Teach the robot as a user does, and return the model; what was taught before into the same folder is used."""
    model = folder / "model.smal"
    if not model.exists():
        camera = f"{CAMERA[0]}x{CAMERA[1]}"
        _smal("demonstrate", "--world", WORLD, "--episodes", "6", "--recoveries", "24", "--seed", "1",
              "--camera", camera, "--out", str(folder / "drives"))  # fmt: skip
        _smal("learn", str(folder / "drives"), "--out", str(model))
    return model


def _smal(*arguments: str) -> None:
    command = tied(sys.executable, "-P", "-c", _SMAL, *arguments)
    done = subprocess.run(command, stdout=subprocess.DEVNULL, check=False)
    if done.returncode:
        raise JobError(f"smal {arguments[0]} failed with status {done.returncode}")
