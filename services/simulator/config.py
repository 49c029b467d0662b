"""Settings of the simulator."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from services.settings import ServiceSettings


class SimulatorSettings(ServiceSettings):
    """The world and the camera."""

    world: str = "campus"
    """Name of a world in deploy/worlds, or the path of an OpenStreetMap file."""
    camera_width: Annotated[int, Field(ge=32, le=4096)] = 1024
    """Columns of the camera image."""
    camera_height: Annotated[int, Field(ge=24, le=3072)] = 768
    """Rows of the camera image."""
    shadows: bool = True
    """Whether the sun casts shadows; without them rendering is faster."""
