"""Options that several commands share, and their checks."""

import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Final, Self, TypeVar

import typer
from pydantic import TypeAdapter
from typer import Option

from schemas.codec import describe
from schemas.episode import GoalName, Victim
from schemas.rpc import Scheme
from schemas.topics import check_robot_id
from services.cli.stack import flags
from services.experiments.engine import Engine
from services.kit.bus import DEFAULT_ROUTER
from services.kit.errors import JobError, UsageError
from services.kit.model_service import AnyModel, load_model, refused
from services.kit.settings import DEFAULT_SECURE_ROUTER, MAX_ROBOTS, ServiceSettings, fleet
from services.simulator.opening import BaseKind
from services.simulator.variation import VARIATIONS, variation_named
from services.simulator.world import World as LoadedWorld
from services.simulator.world import WorldError, load_foreign_world
from smal.features import MODALITY_NAMES, FeatureSettings
from smal.files.container import ModelError

DEFAULT_ROBOT: Final = "rescuebot"
DEFAULT_WORLD: Final = "campus"
_ROUTERS: Final = f"{DEFAULT_ROUTER}; with --secure {DEFAULT_SECURE_ROUTER}"
T = TypeVar("T")


@dataclass(frozen=True)
class CameraOptions:
    """Size of the camera image, pixels."""

    width: int
    height: int

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parse ``WIDTHxHEIGHT``."""
        width, _, height = text.partition("x")
        if not (width.isdecimal() and height.isdecimal()):
            raise UsageError(
                f"--camera {text!r}: invalid; expected WIDTHxHEIGHT, for example 320x240"
            )
        camera = cls(int(width), int(height))
        if not (32 <= camera.width <= 4096 and 24 <= camera.height <= 3072):
            raise UsageError(f"--camera {text!r}: outside 32x24 to 4096x3072")
        return camera


#: A camera image of 1024x768 costs ten times the time of this size.
USUAL_CAMERA: Final = CameraOptions(320, 240)


def fleet_of(robot: str, robots: int) -> tuple[str, ...]:
    """Return the robot ids of a fleet; raise UsageError if an id is too long."""
    try:
        return fleet(robot, robots)
    except ValueError as error:
        raise UsageError(f"--robots {robots}: {error}") from None


def checked(check: Callable[[str], T]) -> Callable[[str], T]:
    """Convert a check that raises ValueError into a parser for Typer."""

    def parse(text: str) -> T:
        try:
            return check(text)
        except ValueError as error:
            raise typer.BadParameter(describe(error)) from None

    return parse


_goal = checked(TypeAdapter(GoalName).validate_python)
_variation = checked(lambda name: variation_named(name).name)
Robot = Annotated[
    str, Option(envvar="SMAL_ROBOT", parser=checked(check_robot_id), metavar="ID", help="Robot id.")
]
Robots = Annotated[
    int,
    Option(
        envvar="SMAL_ROBOTS",
        min=1,
        max=MAX_ROBOTS,
        help="Number of robots; further robots are named ROBOT-2, ROBOT-3 …",
    ),
]
Secure = Annotated[
    Path | None,
    Option(envvar="SMAL_SECURE", help="Folder of certificates, created by `smal secure init`."),
]
Json = Annotated[bool, Option("--json", help="Output as JSON.")]
JsonFile = Annotated[
    Path | None, Option("--json", metavar="FILE", help="File for the results as JSON.")
]
World = Annotated[
    str | None,
    Option(
        help="Name of a world, such as indoor, or file of a map or world. [default: campus; "
        "with --connect the robot's]"
    ),
]
Seed = Annotated[int, Option(min=0, help="Seed of the first episode; episode k uses SEED + k.")]
CameraSize = Annotated[
    CameraOptions | None,
    Option(
        "--camera",
        parser=CameraOptions.parse,
        metavar="WxH",
        help="Size of the camera image. [default: 320x240]",
    ),
]
Base = Annotated[
    BaseKind | None,
    Option(
        help="Motion model: differential drive (physics), car, or exact arcs. [default: physics]"
    ),
]
Goal = Annotated[
    str | None,
    Option(parser=_goal, metavar="NAME", help="Goal, for a model with several goals."),
]
GoalOfDrives = Annotated[
    str, Option(parser=_goal, metavar="NAME", help="Goal of the drives, as for `smal run --goal`.")
]
Modalities = Annotated[
    FeatureSettings | None,
    Option(
        "--modalities",
        parser=checked(FeatureSettings.parse),
        metavar="NAMES",
        help=f"Feature modalities, comma-separated: {', '.join(MODALITY_NAMES)}. [default: "
        "those of the model or the method; else color,hog]",
    ),
]


@dataclass(frozen=True)
class Reach:
    """Address and credentials of a running stack."""

    robot: Robot = DEFAULT_ROBOT
    router: Annotated[
        str | None,
        Option(envvar="SMAL_ROUTER", help=f"Address of the Zenoh router. [default: {_ROUTERS}]"),
    ] = None
    secure: Secure = None

    @property
    def settings(self) -> ServiceSettings:
        """Return the settings of the connection; raise ValidationError for an invalid environment."""
        given: dict[str, Any] = {"robot": self.robot, "secure": self.secure}
        return ServiceSettings(**given | ({} if self.router is None else {"router": self.router}))


@dataclass(frozen=True)
class Simulator:
    """Settings of the simulator; None means the default."""

    camera: CameraSize = None
    shake: Annotated[
        float | None,
        Option(min=0, max=10, help="Strength of the camera shake. [default: 1 indoors, else 0]"),
    ] = None
    base: Base = None
    variation: Annotated[
        str | None,
        Option(
            parser=_variation,
            metavar="NAME",
            help=f"Conditions: {', '.join(VARIATIONS)}. [default: day]",
        ),
    ] = None

    depth: Annotated[
        bool | None, Option(help="Depth camera for avoiding obstacles. [default: depth]")
    ] = None

    def flags(self, world: str) -> tuple[str, ...]:
        """Return the command line flags of the service."""
        camera = self.camera or USUAL_CAMERA
        return flags(**asdict(self) | {"camera": None}, world=world, camera_width=camera.width,
                     camera_height=camera.height)  # fmt: skip


@dataclass(frozen=True)
class Changes:
    """Changes of the world since the demonstration."""

    victim: Annotated[
        Victim,
        Option(
            help="State of the target: moved (a little), or decoy (another object in its place)."
        ),
    ] = "there"
    obstacles: Annotated[
        int, Option(min=0, max=50, help="Number of new obstacles on and beside the route.")
    ] = 0
    people: Annotated[
        int, Option(min=0, max=50, help="Number of people who walk along the route.")
    ] = 0
    blocked: Annotated[bool, Option("--blocked", help="Blocked route.")] = False

    @property
    def other_than_taught(self) -> dict[str, Any]:
        """The requested changes by name."""
        return {
            one.name: value
            for one in fields(self)
            if (value := getattr(self, one.name)) != one.default
        }


@dataclass(frozen=True)
class RunOptions:
    """Options for the stack: a running stack, or a new one for the command."""

    connect: Annotated[
        str | None,
        Option(help=f"Address of a running stack (`smal up`: {_ROUTERS}). [default: a new stack]"),
    ] = None
    secure: Secure = None
    robot: Robot = DEFAULT_ROBOT

    @property
    def settings(self) -> ServiceSettings | None:
        """The settings of the running stack; None for a new stack."""
        if self.connect is None:
            return None
        return ServiceSettings(robot=self.robot, router=self.connect, secure=self.secure)

    def refuse(self, simulator: Simulator, modalities: FeatureSettings | None = None) -> None:
        """Raise UsageError if an option conflicts with `connect`, or needs it."""
        self.refuse_secure()
        if self.connect is not None:
            given = asdict(simulator) | {"modalities": modalities}
            refuse(given, "with --connect; give it to `smal up`")

    def refuse_secure(self) -> None:
        """Raise UsageError for certificates without `connect`: only this machine reaches a new stack."""
        if self.secure is not None and self.connect is None:
            raise UsageError(
                f"--secure {self.secure}: requires --connect; leave it out (or unset SMAL_SECURE)"
            )

    def world(self, world: str | None) -> tuple[str, str | None]:
        """Return the world of a new stack, and the world name to require of the robot, if any."""
        chosen = world or DEFAULT_WORLD
        return chosen, None if world is None and self.connect is not None else read_world(
            chosen
        ).name


@dataclass(frozen=True)
class AtWork:
    """Where the computation runs."""

    workers: Annotated[
        int | None,
        Option(
            min=1,
            max=1024,
            help="Number of worker processes on this machine. [default: one per core for "
            "`evaluate`; else threads]",
        ),
    ] = None
    scheduler: Annotated[
        str | None,
        Option(metavar="ADDRESS", help="Address of a Dask scheduler that computes instead."),
    ] = None
    secure: Secure = None

    def engine(self) -> Engine:
        """Return the engine that computes."""
        if self.workers is not None and self.scheduler is not None:
            raise UsageError("--workers: unsupported with --scheduler")
        return Engine(self.workers, self.scheduler, self.secure)


HERE: Final = AtWork()


@dataclass(frozen=True)
class Use:
    """Use of a model."""

    scheme: Annotated[Scheme | None, Option(help="Required scheme of the model.")] = None
    stride: Annotated[
        int | None,
        Option(min=1, help="Frames per decision, for the paper's scheme. [default: the model's l]"),
    ] = None
    goal: Goal = None


def refuse(given: Mapping[str, object], why: str) -> None:
    """Raise UsageError for the first of some options that is given.

    Parameters
    ----------
    given
        Values of the options by name, without dashes; None means not given.
    why
        Continuation of "--NAME: unsupported", with what to do.
    """
    for name, value in given.items():
        if value is not None:
            raise UsageError(f"--{name}: unsupported {why}")


def existing(path: Path, option: str = "", hint: str = "", *, folder: bool = False) -> Path:
    """Return the path of an input file, or of a folder if allowed; raise UsageError if it is wrong.

    Commands call this before they read, so that later errors are about the content.
    """
    fault = ""
    if not os.access(path, os.F_OK):  # Path.exists raises PermissionError.
        fault = "not found"
    elif not folder and not path.is_file():
        fault = "not a regular file"
    elif not os.access(path, os.R_OK):
        fault = "permission denied"
    if fault:
        raise UsageError(f"{option}{path}: {fault}{hint}")
    return path


def read_world(world: str, option: str = "--world ") -> LoadedWorld:
    """Read a world before the processes start; raise UsageError if there is no such world."""
    mistake = JobError if Path(world).is_file() else UsageError
    try:
        return load_foreign_world(world)
    except WorldError as error:
        prefix = f"{option}{world}: " if option else ""
        raise mistake(f"{prefix}{error}") from None


def loaded(path: Path, option: str = "", hint: str = "") -> AnyModel:
    """Read a model; raise an error with a prefix and a suffix if it is not found or invalid."""
    try:
        return load_model(existing(path, option, hint))
    except ModelError as error:
        raise JobError(f"{option}{error}{hint}") from None


def read_model(path: Path, use: Use) -> AnyModel:
    """Read the model of ``--model``; raise UsageError if it is invalid or unsuitable for this use."""
    model = loaded(path, "--model ")
    if (refusal := refused(model, use.scheme, use.stride, use.goal)) is not None:
        raise UsageError(f"--model {path}: {refusal}")
    return model


def feature_flags(
    modalities: FeatureSettings | None, model: FeatureSettings | None = None
) -> tuple[str, ...]:
    """Return the flags of a features service; raise UsageError if they do not match the model."""
    features = modalities or model or FeatureSettings()
    if "depth" in features.needs:
        raise UsageError(
            f"--modalities {','.join(features.modalities)}: unsupported: recordings contain no "
            "depth images, so no model uses them; omit depth"
        )
    if model is not None and model.fingerprint != features.fingerprint:
        learned_on = ",".join(model.modalities)
        raise UsageError(
            f"--modalities {','.join(features.modalities)}: the model was learned on {learned_on}"
        )
    try:
        # These include the file of a network. It comes from the user only: a model must not start
        # code.
        return "--modalities", features.text
    except ValueError as error:
        raise UsageError(
            f"the model was learned on {','.join(features.modalities)}: {error} (--modalities)"
        ) from None
