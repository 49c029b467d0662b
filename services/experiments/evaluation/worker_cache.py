"""What a worker keeps open from one unit of work to the next: the simulation, the drives, the models."""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.experiments.evaluation.demonstrations import Drive, load_drive
from services.experiments.evaluation.plan import TEACHING_SEED
from services.simulator.opening import open_simulation
from services.simulator.sensors.camera import CameraSettings
from services.simulator.simulation import Simulation
from services.simulator.world.place import Pose
from smal.features import FeatureSettings
from smal.files.container import replacing
from smal.model import Model
from smal.paper.model import Model as PaperModel


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
        self.mapped = lru_cache(maxsize=2)(self._mapped)
        self.drives = lru_cache(maxsize=1)(self._drives)

    @property
    def field_of_view_rad(self) -> float:
        """Of the camera, horizontal."""
        return math.radians(self._camera.field_of_view_deg)

    def _simulation(self, world: str, shake: float | None, variation: str = "day") -> Simulation:
        return open_simulation(world, self._camera, shake=shake, variation=variation)

    def task(self, world: str, start: Pose, victim: Pose) -> Simulation:
        """Open a world with another task than its own."""
        return open_simulation(world, self._camera, task=(start, victim))

    def _model(self, world: str, drives: int, length: int) -> PaperModel:
        return PaperModel.load(self.folder / model_file(world, drives, length))

    def _mapped(self, world: str, drives: int) -> Model:
        return Model.load(self.folder / map_file(world, drives))

    def _drives(self, world: str, count: int) -> tuple[Drive, ...]:
        files = [self.folder / teach_file(world, TEACHING_SEED + k) for k in range(count)]
        return tuple(load_drive(path, self.features) for path in files)

    def poses(self, world: str, drives: int) -> NDArray[np.float64]:
        """Return the true pose of every demonstrated frame, (n, 3)."""
        return np.concatenate([one.poses for one in self.drives(world, drives)])


def teach_file(world: str, seed: int) -> str:
    """Name the file of a drive."""
    return f"teach-{Path(world).stem}-{seed}.npz"


def map_file(world: str, drives: int) -> str:
    """Name the file of a map."""
    return f"map-{Path(world).stem}-{drives}.smal"


def model_file(world: str, drives: int, length: int) -> str:
    """Name the file of a model of the paper's scheme."""
    return f"model-{Path(world).stem}-{drives}-{length}.smal"


def query_file(world: str, seed: int) -> str:
    """Name the file of a held-out drive."""
    return f"queries-{Path(world).stem}-{seed}.npz"


def replace_file(path: Path, arrays: Iterable[tuple[str, NDArray[np.generic]]]) -> None:
    """Write arrays to a file (npz) that is there only when it is complete."""
    with replacing(path) as file:
        np.savez(file, **dict(arrays))  # type: ignore[arg-type]
