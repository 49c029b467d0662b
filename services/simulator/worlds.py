"""The simulator's settings, and the worlds that its robot can be in, by name."""

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

_NAME: Final[TypeAdapter[str]] = TypeAdapter(WorldName)


class SimulatorSettings(RobotSettings, RootSettings):
    """The world and the camera; worlds in the folder ``worlds`` below the root can be chosen as well."""

    attended: bool = False
    """Whether the robot moves only while an operator is there."""
    task: Literal["victim", "operator"] = "victim"
    """Who says that the goal is reached: the simulator, when the victim is near and in view; or only the person at smal
    teleop, as with a real robot."""
    world: str = "campus"
    """Name of a world that comes with the project, or the path of an OpenStreetMap or world file."""
    camera_width: Annotated[int, Field(ge=32, le=4096)] = 1024
    """Columns of the camera image."""
    camera_height: Annotated[int, Field(ge=24, le=3072)] = 768
    """Rows of the camera image."""
    shake: Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)] | None = None
    """How much the camera shakes while the robot drives: 0 not at all, 1 as on a floor that is not quite even; as is
    usual in the world if not given."""
    base: BaseKind = "physics"
    """How the robot moves: by driven wheels with mass and friction, or along exact arcs (kinematic)."""
    variation: str = "day"
    """Conditions other than those of a fair day, for example evening, haze or moved; `smal up --help` lists them."""

    depth: bool = True
    """Whether the robot has a depth camera, by which it stands before what it would run into, and goes round it."""

    @field_validator("variation")
    @classmethod
    def _known(cls, name: str) -> str:
        return variation_named(name).name


class Worlds:
    """Opens worlds: those of the project, those in ``worlds/`` below the root, and the one that the settings name."""

    def __init__(self, settings: SimulatorSettings) -> None:
        self._settings = settings
        self._first = Path(settings.world).stem
        self.here = (
            self._first,
            settings.variation,
        )  # The world that was opened last, and its variation.

    def names(self) -> list[str]:
        """Return the names of all worlds that can be asked for, sorted."""
        own = [path.stem for path in (self._settings.root / WORLDS).glob("*.json")]
        return sorted({*known_worlds(), *filter(_may_be_asked_for, [self._first, *own])})

    def open(self, world: str | None = None, variation: str | None = None) -> Simulation:
        """Open a world under some conditions, both as they were if not given; a `ServiceError` where that cannot be."""
        world = world or self.here[0]
        variation = variation or self.here[1]
        if variation not in VARIATIONS:
            raise ServiceError(f"no variation {variation!r}; known are {', '.join(VARIATIONS)}")
        of = self._settings
        camera = CameraSettings(of.camera_width, of.camera_height)
        try:
            simulation = open_simulation(
                self._place(world),
                camera,
                base=of.base,
                shake=of.shake,
                variation=variation,
                depth=of.depth,
            )
        except JobError as error:
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
    with suppress(ValidationError):
        return bool(_NAME.validate_python(name))
    return False
