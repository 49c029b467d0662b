"""A model of a small world, for a robot that is to drive by itself while it is disturbed."""

from __future__ import annotations

from pathlib import Path

from services.kit.errors import JobError
from tests.benchmarks.drives import demonstrate, learn
from tests.benchmarks.faults.rig import CAMERA, WORLD
from tests.benchmarks.results import LeftOutError


def taught_model(folder: Path) -> Path:
    """Teach the robot as a user does, and return the model; what was taught before into the same folder is used."""
    model = folder / "model.smal"
    if model.exists():
        return model
    try:
        demonstrate(folder, 1, 0, WORLD, f"{CAMERA[0]}x{CAMERA[1]}")
    except LeftOutError as error:
        raise JobError(str(error)) from None
    return learn(folder)
