"""Options that several commands share: declared once, and checked where they are read."""

from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Final, Self, TypeVar

import typer
from pydantic import TypeAdapter, ValidationError
from typer import Option

from schemas.codec import describe
from schemas.episode import GoalName, Victim
from schemas.rpc import Scheme
from schemas.topics import check_robot_id
from services.cli.stack import flags
from services.experiments.engine import Engine
from services.kit.bus import DEFAULT_ROUTER
from services.kit.errors import UsageError
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
    """Size of the camera image."""

    width: int
    height: int

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read ``WIDTHxHEIGHT``; UsageError says what is wrong with it."""
        width, _, height = text.partition("x")
        if not (width.isdecimal() and height.isdecimal()):
            raise UsageError(f"--camera {text!r}: expected WIDTHxHEIGHT, for example 1024x768")
        camera = cls(int(width), int(height))
        if not (32 <= camera.width <= 4096 and 24 <= camera.height <= 3072):
            raise UsageError(f"--camera {text!r}: from 32x24 to 4096x3072")
        return camera


USUAL_CAMERA: Final = CameraOptions(1024, 768)


def fleet_of(robot: str, robots: int) -> tuple[str, ...]:
    """Return the ids of the robots of a fleet; UsageError where one becomes too long."""
    try:
        return fleet(robot, robots)
    except ValueError as error:
        raise UsageError(f"--robots {robots}: {error}") from None


def checked(check: Callable[[str], T]) -> Callable[[str], T]:
    """Make a parser for Typer of a check; what raises ValueError there is bad use, and why is said in one line."""

    def parse(text: str) -> T:
        try:
            return check(text)
        except ValueError as error:
            raise typer.BadParameter(
                describe(error) if isinstance(error, ValidationError) else str(error)
            ) from None

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
        help="How many robots; the others are ROBOT-2 and so on.",
    ),
]
Secure = Annotated[
    Path | None, Option(envvar="SMAL_SECURE", help="Certificates by `smal secure init`.")
]
Json = Annotated[bool, Option("--json", help="Print JSON.")]
JsonFile = Annotated[
    Path | None, Option("--json", metavar="FILE", help="Write the results as JSON.")
]
World = Annotated[
    str | None,
    Option(
        help="A name, such as indoor, or a map's or world's file. [default: campus; with --connect the robot's]"
    ),
]
Seed = Annotated[int, Option(min=0, help="Seed of the first episode; episode k uses SEED + k.")]
CameraSize = Annotated[
    CameraOptions | None,
    Option(
        "--camera",
        parser=CameraOptions.parse,
        metavar="WxH",
        help="Camera image. [default: 1024x768; of `smal up` 640x480]",
    ),
]
Base = Annotated[
    BaseKind | None,
    Option(help="Driven wheels (physics), those of a car, or exact arcs. [default: physics]"),
]
Goal = Annotated[
    str | None,
    Option(parser=_goal, metavar="NAME", help="Where to go, in a model with several goals."),
]
GoalOfDrives = Annotated[
    str, Option(parser=_goal, metavar="NAME", help="Where drives lead; see `smal run --goal`.")
]
Modalities = Annotated[
    FeatureSettings | None,
    Option(
        "--modalities",
        parser=checked(FeatureSettings.parse),
        metavar="NAMES",
        help=f"Feature modalities, separated by commas, out of {', '.join(MODALITY_NAMES)}. "
        "[default: those of the model or the method; else color,hog]",
    ),
]


@dataclass(frozen=True)
class Reach:
    """How a running stack is reached."""

    robot: Robot = DEFAULT_ROBOT
    router: Annotated[
        str | None, Option(envvar="SMAL_ROUTER", help=f"The Zenoh router. [default: {_ROUTERS}]")
    ] = None
    secure: Secure = None

    @property
    def settings(self) -> ServiceSettings:
        """The same as settings; ValidationError where the environment has some that cannot be used."""
        given: dict[str, Any] = {"robot": self.robot, "secure": self.secure}
        return ServiceSettings(**given | ({} if self.router is None else {"router": self.router}))


@dataclass(frozen=True)
class Simulator:
    """How a simulator is started; None leaves a setting at its default."""

    camera: CameraSize = None
    shake: Annotated[
        float | None, Option(min=0, max=10, help="Of the camera. [default: 1 indoors, else 0]")
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
        bool | None, Option(help="With a depth camera, to go round things. [default: depth]")
    ] = None

    def flags(self, world: str, usual: CameraOptions = USUAL_CAMERA) -> tuple[str, ...]:
        """Return the flags of the service."""
        camera = self.camera or usual
        return flags(**asdict(self) | {"camera": None}, world=world, camera_width=camera.width,
                     camera_height=camera.height)  # fmt: skip


@dataclass(frozen=True)
class Changes:
    """What is other than it was when the way was taught."""

    victim: Annotated[
        Victim,
        Option(
            help="How the victim lies; moved: a little elsewhere; decoy: something else in its place."
        ),
    ] = "there"
    obstacles: Annotated[
        int, Option(min=0, max=50, help="Things on and beside the way that were not there.")
    ] = 0
    people: Annotated[
        int, Option(min=0, max=50, help="People who walk about the way, to and fro.")
    ] = 0
    blocked: Annotated[bool, Option("--blocked", help="Closed way.")] = False

    @property
    def other_than_taught(self) -> dict[str, Any]:
        """The changes that were asked for, by name."""
        return {
            one.name: value
            for one in fields(self)
            if (value := getattr(self, one.name)) != one.default
        }


@dataclass(frozen=True)
class RunOptions:
    """Which stack a command works with: one that runs, or one of its own."""

    connect: Annotated[
        str | None, Option(help=f"Use the stack at this router (`smal up`: {_ROUTERS}).")
    ] = None
    secure: Secure = None
    robot: Robot = DEFAULT_ROBOT

    @property
    def settings(self) -> ServiceSettings | None:
        """How the running stack is reached; None for one of its own."""
        if self.connect is None:
            return None
        return ServiceSettings(robot=self.robot, router=self.connect, secure=self.secure)

    def refuse(self, simulator: Simulator, modalities: FeatureSettings | None = None) -> None:
        """Refuse with `connect` what the running stack has already; raises UsageError when there is something of it."""
        for name, value in (asdict(simulator) | {"modalities": modalities}).items():
            if value is not None and self.connect is not None:
                raise UsageError(
                    f"--{name}: with --connect the running stack has its own; give it to `smal up`"
                )

    def world(self, world: str | None) -> tuple[str, str | None]:
        """Return the world to start a stack in, and the name that the robot's must have, if any; or UsageError."""
        chosen = world or DEFAULT_WORLD
        return chosen, None if world is None and self.connect is not None else read_world(
            chosen
        ).name


@dataclass(frozen=True)
class AtWork:
    """Who computes."""

    workers: Annotated[
        int | None,
        Option(
            min=1,
            max=1024,
            help="Processes at work here. [default: one a core for `evaluate`; else threads]",
        ),
    ] = None
    scheduler: Annotated[
        str | None, Option(metavar="ADDRESS", help="Compute at a scheduler of Dask instead.")
    ] = None
    secure: Secure = None

    def engine(self) -> Engine:
        """Return what computes; UsageError where it cannot be such."""
        if self.workers is not None and self.scheduler is not None:
            raise UsageError("--workers: a scheduler (--scheduler) has its own")
        return Engine(self.workers, self.scheduler, self.secure)


HERE: Final = AtWork()


@dataclass(frozen=True)
class Use:
    """How a model is used."""

    scheme: Annotated[
        Scheme | None, Option(help="Refuse a model that was learned for another scheme.")
    ] = None
    stride: Annotated[
        int | None, Option(min=1, help="Paper: frames a decision. [default: the model's l]")
    ] = None
    goal: Goal = None


def read_world(world: str) -> LoadedWorld:
    """Read the world of ``--world`` before the processes start; UsageError says what is wrong with it."""
    try:
        return load_foreign_world(world)
    except WorldError as error:
        raise UsageError(f"--world {world}: {error}") from None


def loaded(path: Path, option: str = "", hint: str = "") -> AnyModel:
    """Read a model; UsageError, with what a user is told before and after, when it is none."""
    try:
        return load_model(path)
    except ModelError as error:
        raise UsageError(f"{option}{error}{hint}") from None


def read_model(path: Path, use: Use) -> AnyModel:
    """Read the model of ``--model``; UsageError when it is none, or not for this use."""
    model = loaded(path, "--model ")
    if (refusal := refused(model, use.scheme, use.stride, use.goal)) is not None:
        raise UsageError(f"--model {path}: {refusal}")
    return model


def feature_flags(
    modalities: FeatureSettings | None, model: FeatureSettings | None = None
) -> tuple[str, ...]:
    """Return the flags of a features service; UsageError: the model was learned on others, or on a file not given."""
    features = modalities or model or FeatureSettings()
    if "depth" in features.needs:
        raise UsageError(
            f"--modalities {','.join(features.modalities)}: recordings hold no depth images, so no "
            "model is learned on them; omit depth"
        )
    if model is not None and model.fingerprint != features.fingerprint:
        learned_on = ",".join(model.modalities)
        raise UsageError(
            f"--modalities {','.join(features.modalities)}: the model was learned on {learned_on}"
        )
    try:
        # Of a network it has the file, which only the user gives: what a model says makes nothing run.
        return "--modalities", features.text
    except ValueError as error:
        raise UsageError(
            f"the model was learned on {','.join(features.modalities)}: {error} (--modalities)"
        ) from None
