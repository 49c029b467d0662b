"""The worlds that the simulated robot can be in, by name."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from pydantic import TypeAdapter, ValidationError

from schemas.rpc import WorldName
from services.kit.node import ServiceError
from services.kit.root import WORLDS, OutsideError, below
from services.simulator.camera import CameraSettings
from services.simulator.config import SimulatorSettings
from services.simulator.scene.vulkan import UnavailableError
from services.simulator.simulation import Simulation, open_simulation
from services.simulator.variation import VARIATIONS
from services.simulator.world import WorldError, known_worlds

_NAME: Final[TypeAdapter[str]] = TypeAdapter(WorldName)


class Worlds:
    """Opens worlds: those of the project, those in ``worlds/`` below the root, and the one that the settings name."""

    def __init__(self, settings: SimulatorSettings) -> None:
        self._settings = settings
        self._first = Path(settings.world).stem
        #: The world that was opened last, and its variation.
        self.here = self._first, settings.variation

    def names(self) -> list[str]:
        """Return the names of all worlds that can be asked for, sorted."""
        own = [path.stem for path in (self._settings.root / WORLDS).glob("*.json")]
        return sorted({*known_worlds(), *filter(_may_be_asked_for, [self._first, *own])})

    def open(self, world: str | None = None, variation: str | None = None) -> Simulation:
        """Open a world under some conditions, both as they were if not given; a `ServiceError` where that cannot be."""
        world, variation = world or self.here[0], variation or self.here[1]
        if variation not in VARIATIONS:
            raise ServiceError(f"no variation {variation!r}; known are {', '.join(VARIATIONS)}")
        of = self._settings
        camera = CameraSettings(of.camera_width, of.camera_height, of.shadows)
        try:
            simulation = open_simulation(
                self._place(world), camera, base=of.base, shake=of.shake, variation=variation
            )
        except (WorldError, UnavailableError) as error:
            # Where the files lie means nothing to who asks for a name.
            raise ServiceError(str(error).replace(f"{self._settings.root / WORLDS}/", "")) from None
        self.here = world, variation
        return simulation

    def _place(self, world: str) -> str:
        """Return what `load_world` knows a world by; a link below the root leads nowhere else."""
        if world == self._first:
            return self._settings.world
        if world in known_worlds():
            return world
        try:
            path = below(self._settings.root, f"{WORLDS}/{world}.json")
        except OutsideError as error:
            raise ServiceError(f"world {world!r}: {error}") from None
        if not path.is_file():
            raise ServiceError(f"no world {world!r}; known are {', '.join(self.names())}")
        return str(path)


def _may_be_asked_for(name: str) -> bool:
    try:
        _NAME.validate_python(name)
    except ValidationError:
        return False
    return True
