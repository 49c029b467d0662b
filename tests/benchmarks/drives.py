"""Drives and models that a benchmark makes as a user does, with the `smal` command."""

import subprocess
import sys
from pathlib import Path
from typing import Final

from services.cli.child import tied
from services.kit.errors import JobError

_SMAL: Final = "from services.cli.main import main; main()"


def taught(folder: Path, episodes: int, recoveries: int, world: str, camera: str) -> Path:
    """Have the expert drive, and learn from it; return the model, in the folder of the drives.

    Raises
    ------
    JobError
        A command failed, and has said why on standard error.
    """
    model = folder / "model.smal"
    if not model.exists():
        _smal("demonstrate", "--world", world, "--episodes", episodes, "--recoveries", recoveries, "--camera", camera,
              "--out", folder)  # fmt: skip
        _smal("learn", folder, "--out", model)
    return model


def _smal(*arguments: object) -> None:
    command = tied(sys.executable, "-P", "-c", _SMAL, *map(str, arguments))
    if subprocess.run(command, stdout=subprocess.DEVNULL, check=False).returncode:
        raise JobError(f"smal {arguments[0]} failed")
