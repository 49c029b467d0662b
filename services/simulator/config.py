"""Settings of the simulator."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator

from services.kit.root import RootSettings
from services.robot.config import RobotSettings
from services.simulator.simulation import BaseKind
from services.simulator.variation import variation_named


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
    shadows: bool = True
    """Whether the sun casts shadows; without them rendering is faster."""
    shake: Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)] | None = None
    """How much the camera shakes while the robot drives: 0 not at all, 1 as on a floor that is not quite even; as is
    usual in the world if not given."""
    base: BaseKind = "physics"
    """How the robot moves: by driven wheels with mass and friction, or along exact arcs (kinematic)."""
    variation: str = "day"
    """Conditions other than those of a fair day, for example evening, haze or moved; `smal up --help` lists them."""

    @field_validator("variation")
    @classmethod
    def _known(cls, name: str) -> str:
        return variation_named(name).name
