"""Options that several commands share, so that they are spelled and explained the same way everywhere."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final, Self

import typer

from services.bus import DEFAULT_ROUTER
from services.commands.errors import UsageError
from services.simulator.world import WorldError, load_world

DEFAULT_ROBOT: Final = "rescuebot"

Robot = Annotated[str, typer.Option(envvar="SMAL_ROBOT", help="Robot id, part of every topic's key.")]
Router = Annotated[str, typer.Option(envvar="SMAL_ROUTER", help="Address of the stack's Zenoh router.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]
World = Annotated[str, typer.Option(help="World: a name in deploy/worlds, or the path of an OpenStreetMap file.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed of the first episode; episode k uses SEED + k.")]
CameraSize = Annotated[str, typer.Option("--camera", help="Camera image, WIDTHxHEIGHT; smaller renders faster.")]
Connect = Annotated[
    str | None,
    typer.Option(help=f"Use the running stack whose router is at this address (`smal up`: {DEFAULT_ROUTER})."),
]
Model = Annotated[Path, typer.Option(help="Model file, made by `smal learn`.")]


@dataclass(frozen=True)
class Camera:
    """Size of the camera image."""

    width: int
    height: int

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read ``WIDTHxHEIGHT``.

        Raises
        ------
        UsageError
            When the text is not two whole numbers within 32x24 and 4096x3072.
        """
        width, _, height = text.partition("x")
        if not (width.isdecimal() and height.isdecimal()):
            raise UsageError(f"--camera {text!r}: expected WIDTHxHEIGHT, for example 1024x768")
        camera = cls(int(width), int(height))
        if not (32 <= camera.width <= 4096 and 24 <= camera.height <= 3072):
            raise UsageError(f"--camera {text!r}: from 32x24 to 4096x3072")
        return camera


def check_world(world: str) -> None:
    """Read a world, to say what is wrong with it before six processes start.

    Raises
    ------
    UsageError
        When there is no such world, or its file is no map.
    """
    try:
        load_world(world)
    except WorldError as error:
        raise UsageError(f"--world {world}: {error}") from None
