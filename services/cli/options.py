"""Options that several commands share, so that they are spelled and explained the same way everywhere."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Self

import typer
from pydantic import ValidationError

from schemas.codec import describe
from schemas.rpc import ResetRequest, Scheme
from schemas.topics import check_robot_id
from services.kit.bus import DEFAULT_ROUTER
from services.kit.errors import UsageError
from services.kit.model_service import AnyModel, load_model, refused
from services.kit.settings import DEFAULT_SECURE_ROUTER, ServiceSettings
from services.simulator.variation import VARIATIONS
from services.simulator.world import WorldError, load_world
from services.simulator.world.place import World as LoadedWorld
from smal.files.container import ModelError

DEFAULT_ROBOT: Final = "rescuebot"
DEFAULT_WORLD: Final = "campus"

Robot = Annotated[str, typer.Option(envvar="SMAL_ROBOT", help="Robot id, part of every topic's key.")]
Router = Annotated[
    str | None,
    typer.Option(
        envvar="SMAL_ROUTER",
        help=f"Address of the stack's Zenoh router. [default: {DEFAULT_ROUTER}; with --secure {DEFAULT_SECURE_ROUTER}]",
    ),
]
Secure = Annotated[
    Path | None,
    typer.Option(envvar="SMAL_SECURE", help="Folder of certificates, made by `smal secure init`."),
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]
World = Annotated[
    str, typer.Option(help="World: a name, such as campus or indoor, or the path of an OpenStreetMap or world file.")
]
WorldOfStack = Annotated[
    str | None,
    typer.Option(
        "--world",
        help="World: a name, such as campus or indoor, or the path of an OpenStreetMap or world file. "
        "[default: campus; with --connect whatever the robot is in]",
    ),
]
Seed = Annotated[int, typer.Option(min=0, help="Seed of the first episode; episode k uses SEED + k.")]
CameraSize = Annotated[str, typer.Option("--camera", help="Camera image, WIDTHxHEIGHT; smaller renders faster.")]
OwnCameraSize = Annotated[
    str | None,
    typer.Option("--camera", help="Camera image, WIDTHxHEIGHT; smaller renders faster. [default: 1024x768]"),
]
Base = Annotated[
    str | None,
    typer.Option(help="physics: driven wheels with mass and friction; kinematic: exact arcs. [default: physics]"),
]
Variation = Annotated[
    str | None,
    typer.Option(help=f"Conditions other than those of a fair day: {', '.join(VARIATIONS)}. [default: day]"),
]
Shake = Annotated[
    float | None,
    typer.Option(min=0, max=10, help="How much the camera shakes in driving. [default: 1 indoors, 0 outdoors]"),
]
Connect = Annotated[
    str | None,
    typer.Option(
        help=f"Use the running stack whose router is at this address (`smal up`: {DEFAULT_ROUTER}; with --secure "
        f"{DEFAULT_SECURE_ROUTER})."
    ),
]
ModelFile = Annotated[Path, typer.Option(help="Model file, made by `smal learn`.")]
SchemeOption = Annotated[
    Scheme | None,
    typer.Option("--scheme", help="Refuse a model that was not learned for this scheme, filter or paper."),
]
Goal = Annotated[str | None, typer.Option(help="Where to go, in a model with several goals.")]
GoalOfDrives = Annotated[
    str, typer.Option(help="Name of the place that the drives lead to, for `smal run --goal` with what is learned.")
]
Stride = Annotated[
    int | None,
    typer.Option(min=1, help="Frames from one decision to the next, of the paper's scheme. [default: the model's l]"),
]


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


def camera_of_own_stack(camera: str | None, connect: str | None) -> Camera:
    """Read ``--camera`` of a command that starts a stack of its own unless it connects to another.

    Raises
    ------
    UsageError
        When the text is no size, or the camera belongs to a stack that runs already.
    """
    if camera is not None and connect is not None:
        raise UsageError("--camera: with --connect the running stack has its camera; give it to `smal up`")
    return Camera.parse(camera or "1024x768")


def settings_for(robot: str, router: str | None, secure: Path | None) -> ServiceSettings:
    """Return how a stack is reached.

    Raises
    ------
    UsageError
        When the robot's id cannot be part of a key, or the environment has settings that cannot be used.
    """
    check_robot(robot)
    try:
        given: dict[str, Any] = {"robot": robot, "secure": secure} | ({} if router is None else {"router": router})
        return ServiceSettings(**given)
    except ValidationError as error:
        raise UsageError(describe(error)) from None


def check_robot(robot: str) -> str:
    """Return a robot id.

    Raises
    ------
    UsageError
        When it cannot be part of a key.
    """
    try:
        return check_robot_id(robot)
    except ValueError as error:
        raise UsageError(f"--robot: {error}") from None


def check_goal(goal: str) -> str:
    """Return the name of a goal.

    Raises
    ------
    UsageError
        When it is empty, too long or has control characters.
    """
    try:
        return ResetRequest(seed=0, goal=goal).goal
    except ValidationError as error:
        raise UsageError(f"--goal: {describe(error)}") from None


def world_of_stack(world: str | None, connect: str | None) -> tuple[str, str | None]:
    """Return the world of a stack that is started, and the name that the robot's world must have, if any.

    Raises
    ------
    UsageError
        When there is no such world, or its file is no map.
    """
    chosen = world or DEFAULT_WORLD
    return chosen, None if world is None and connect is not None else check_world(chosen)


def check_world(world: str) -> str:
    """Read a world, to say what is wrong with it before the processes start; return its name; see `read_world`."""
    return read_world(world).name


def read_world(world: str) -> LoadedWorld:
    """Read the world of ``--world``.

    Raises
    ------
    UsageError
        When there is no such world, or its file is no map.
    """
    try:
        return load_world(world)
    except WorldError as error:
        raise UsageError(f"--world {world}: {error}") from None


def read_model(path: Path, scheme: Scheme | None, stride: int | None = None, goal: str | None = None) -> AnyModel:
    """Read the model of ``--model``, for which ``--scheme``, ``--stride`` and ``--goal`` must be right.

    Raises
    ------
    UsageError
        When the file is no model, or cannot be used so.
    """
    try:
        model = load_model(path)
    except ModelError as error:
        raise UsageError(f"--model {error}") from None
    refusal = refused(model, scheme, stride, goal)
    if refusal is not None:
        raise UsageError(f"--model {path}: {refusal}")
    return model
