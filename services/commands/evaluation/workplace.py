"""What a worker keeps open from one unit of work to the next: the simulation, the drives, the models."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.commands.evaluation.demonstrations import Drive, load_drives
from services.commands.evaluation.units import Unit
from services.simulator.opening import open_simulation
from services.simulator.sensors.camera import CameraSettings
from services.simulator.simulation import Simulation
from smal.container import replacing
from smal.features import FeatureSettings
from smal.model import Model


class Workplace:
    """Files and open simulations of one worker.

    Parameters
    ----------
    folder
        ``work`` of the results.
    camera
        Size of the image, pixels.
    """

    def __init__(self, folder: Path, camera: tuple[int, int]) -> None:
        self.folder = folder
        self.features = FeatureSettings()
        self._camera = CameraSettings(*camera)
        # Two worlds at most are at work at a time; a model with its inner products may take a gigabyte.
        self.simulation = lru_cache(maxsize=4)(self._simulation)
        self.model = lru_cache(maxsize=2)(self._model)
        self.drives = lru_cache(maxsize=1)(self._drives)

    def _simulation(self, world: str, shake: float | None) -> Simulation:
        return open_simulation(world, self._camera, shake=shake)

    def _model(self, world: str, teaching: str, length: int) -> Model:
        return Model.load(self.folder / model_file(world, teaching, length))

    def _drives(self, world: str, teaching: str) -> tuple[Drive, ...]:
        files = sorted(self.folder.glob(f"teach-{world}-{teaching}-*.npz"), key=_order)
        return tuple(one for path in files for one in load_drives(path, self.features))

    def poses(self, world: str, teaching: str) -> NDArray[np.float64]:
        """Return the true pose of every demonstrated frame, (n, 3)."""
        return np.concatenate([one.poses for one in self.drives(world, teaching)])


def teach_file(unit: Unit) -> str:
    """Name the file of the drives of a unit."""
    return f"teach-{unit.world}-{unit['teaching']}-{unit['purpose']}-{unit['seed']}.npz"


def _order(path: Path) -> tuple[bool, int]:
    """Whole drives first, each kind by its seed, as `smal learn` would read them."""
    purpose, seed = path.stem.split("-")[-2:]
    return purpose != "drive", int(seed)


def model_file(world: str, teaching: str, length: int) -> str:
    """Name the file of a model."""
    return f"model-{world}-{teaching}-{length}.smal"


def query_file(world: str, seed: int) -> str:
    """Name the file of a held-out drive."""
    return f"queries-{world}-{seed}.npz"


def replace_file(path: Path, arrays: Iterable[tuple[str, NDArray[np.generic]]]) -> None:
    """Write arrays to a file (npz) that is there only when it is complete."""
    with replacing(path) as file:
        np.savez(file, **dict(arrays))  # type: ignore[arg-type]
