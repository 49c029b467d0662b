"""Settings of the simulator, and its worlds by name."""

from contextlib import suppress
from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import Field, TypeAdapter, ValidationError, field_validator

from schemas.rpc import WorldName
from services.kit.errors import JobError
from services.kit.node import ServiceError
from services.kit.root import WORLDS, OutsideError, RootSettings, below
from services.robot.service import RobotSettings
from services.simulator.opening import BaseKind, open_simulation
from services.simulator.sensors.camera import CameraSettings
from services.simulator.simulation import Simulation
from services.simulator.variation import VARIATIONS, variation_named
from services.simulator.world import known_worlds
from services.simulator.world.place import Pose

_NAME: Final[TypeAdapter[str]] = TypeAdapter(WorldName)


class SimulatorSettings(RobotSettings, RootSettings):
    """World and camera; worlds in the folder ``worlds`` below the root are available as well."""

    attended: bool = False
    """Whether the robot moves only while an operator is present"""
    task: Literal["victim", "operator"] = "victim"
    """Decision that the goal is reached: by the simulator (victim near and in view), or by the
    operator as with a real robot"""
    world: str = "campus"
    """Name of an included world, or path of an OpenStreetMap or world file"""
    camera_width: Annotated[int, Field(ge=32, le=4096)] = 320
    """Columns of the camera image"""
    camera_height: Annotated[int, Field(ge=24, le=3072)] = 240
    """Rows of the camera image"""
    shake: Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)] | None = None
    """Camera shake while the robot drives (0 = off, 1 = slightly uneven floor); by default the
    world's own"""
    base: BaseKind = "physics"
    """Drive model: wheels with mass and friction, or exact arcs (kinematic)"""
    variation: str = "day"
    """Conditions such as evening, haze or moved; `smal up --help` lists them"""

    depth: bool = True
    """Whether the robot has a depth camera, to stop before obstacles and drive around them"""

    @field_validator("variation")
    @classmethod
    def _known(cls, name: str) -> str:
        return variation_named(name).name


class Worlds:
    """Opens included worlds, worlds in ``worlds/`` below the root, and the configured world."""

    def __init__(self, settings: SimulatorSettings) -> None:
        self._settings = settings
        self._first = Path(settings.world).stem
        # World and variation that were opened last.
        self.here = (
            self._first,
            settings.variation,
        )
        # Start and victim that a person has chosen, by world.
        self.tasks: dict[str, tuple[Pose, Pose]] = {}

    def names(self) -> list[str]:
        """Return the sorted names of all available worlds."""
        own = [path.stem for path in (self._settings.root / WORLDS).glob("*.json")]
        return sorted({*known_worlds(), *filter(_may_be_asked_for, [self._first, *own])})

    def open(self, world: str | None = None, variation: str | None = None) -> Simulation:
        """Open a world; by default the current world and variation.

        Raises
        ------
        ServiceError
            The world or variation is not found, or the world is unusable.
        """
        world = world or self.here[0]
        variation = variation or self.here[1]
        if variation not in VARIATIONS:
            raise ServiceError(
                f"variation {variation!r} not found; choose from {', '.join(VARIATIONS)}"
            )
        of = self._settings
        camera = CameraSettings(of.camera_width, of.camera_height)
        try:
            simulation = open_simulation(
                self._place(world),
                camera,
                base=of.base,
                shake=of.shake,
                variation=variation,
                task=self.tasks.get(world),
                depth=of.depth,
            )
        except JobError as error:
            # Clients use names and do not need the folder.
            raise ServiceError(str(error).replace(f"{self._settings.root / WORLDS}/", "")) from None
        self.here = world, variation
        return simulation

    def _place(self, world: str) -> str:
        """Return the name or path for `load_world`; links below the root cannot lead outside."""
        if world == self._first:
            return self._settings.world
        if world in known_worlds():
            return world
        try:
            path = below(self._settings.root, f"{WORLDS}/{world}.json")
        except OutsideError as error:
            raise ServiceError(f"world {world!r}: {error}") from None
        if not path.is_file():
            raise ServiceError(f"world {world!r} not found; choose from {', '.join(self.names())}")
        return str(path)


def _may_be_asked_for(name: str) -> bool:
    with suppress(ValidationError):
        return bool(_NAME.validate_python(name))
    return False
