"""Drivers by name: the methods of this repository, and others by ``MODULE:CLASS``."""

import ast
import hashlib
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, Final, TypeVar, cast

import numpy as np

from services.kit.errors import JobError, UsageError, foreign_error
from services.simulator.sensors.camera import FIELD_OF_VIEW_DEG
from smal.arrays import Uint8s
from smal.evaluation.driver import Depth, Driver, LearnDriver, PlaceEstimate
from smal.evaluation.drivers import PaperDriver, SmalDriver
from smal.evaluation.nearest import NearestImitation
from smal.evaluation.place_filter import PlaceFilter
from smal.evaluation.teach_and_repeat import TeachAndRepeat
from smal.features import FeatureSettings
from smal.movement import Motion
from smal.paper.learning import LearningSettings
from smal.planning import Said
from smal.teaching.demonstration import Demonstration

FEATURES: Final = FeatureSettings()  # Features of all drives and queries.
#: Packages whose code every unit's name contains.
_OURS: Final = ("schemas", "services", "smal")
FIELD_RAD: Final = math.radians(FIELD_OF_VIEW_DEG)
DEFAULT_LENGTH: Final = LearningSettings().sequence_length
LENGTHS: Final = (1, 2, 5, 10, 20, 40)  # Sequence lengths of the paper's scheme.
T = TypeVar("T")


class DriverError(JobError):
    """A driver raised an error or gave an invalid answer; the other drivers can continue."""


@dataclass(frozen=True)
class DriverEntry:
    """A driver, with its title and meaning on the page."""

    title: str
    meaning: str
    learn: LearnDriver
    # Sequence length of the paper's scheme. Without recoveries it has no states beside the route.
    length: int | None = None
    guarded: bool = True  # Whether the robot has its depth camera, and so its guard.


def _imitating(frames: int, drives: Sequence[Demonstration], folder: Path) -> Driver:
    del folder
    return NearestImitation(drives, FEATURES, frames)


def _repeating(told: bool, drives: Sequence[Demonstration], folder: Path) -> Driver:
    del folder
    return TeachAndRepeat(drives, FIELD_RAD, told=told)


def _filtering(drives: Sequence[Demonstration], folder: Path) -> Driver:
    del folder
    return PlaceFilter(drives, FEATURES, FIELD_RAD)


def _smal(avoids: bool, drives: Sequence[Demonstration], folder: Path) -> Driver:
    return SmalDriver.taught(drives, folder, FEATURES, avoids=avoids)


def _paper(length: int, drives: Sequence[Demonstration], folder: Path) -> Driver:
    return PaperDriver.taught(drives, folder, FEATURES, length)


#: Drivers by name. All learn from the same drives.
DRIVERS: Final[dict[str, DriverEntry]] = {
    "smal": DriverEntry(
        "SMAL", "the filter and the planner, at every frame", partial(_smal, True)
    ),
    "teach-and-repeat": DriverEntry(
        "teach and repeat",
        "wheels, corrected by the shift of the image (Dall'Osto et al. 2021)",
        partial(_repeating, False),
    ),
    "teach-and-repeat-told": DriverEntry(
        "teach and repeat, told",
        "the same, with the start of the drive given",
        partial(_repeating, True),
    ),
    "place-filter": DriverEntry(
        "place filter",
        "a Bayes filter over places (Suomela et al. 2024), the taught velocity, and the shift of "
        "the image (Broughton et al. 2021)",
        _filtering,
    ),
    **{
        f"paper-{length}": DriverEntry(
            f"the paper's scheme, l = {length}", "a decision every l frames",
            partial(_paper, length), length=length,
        )
        for length in LENGTHS
    },
    "nearest-1": DriverEntry(
        "nearest frame", "repeats the action at the most similar frame", partial(_imitating, 1)
    ),
    "nearest-5": DriverEntry(
        "nearest 5 frames",
        "repeats the action at the end of the most similar five frames",
        partial(_imitating, 5),
    ),
    "smal-waits": DriverEntry(
        "SMAL, stop and wait",
        "without depth images: its guard alone stops it before an obstacle",
        partial(_smal, False),
    ),
    "smal-unguarded": DriverEntry(
        "SMAL, avoidance off",
        "without a depth camera, and so without a guard",
        partial(_smal, False),
        guarded=False,
    ),
}  # fmt: skip
#: Drivers of a comparison by default.
COMPARED: Final = ("smal", "teach-and-repeat", "place-filter", "nearest-5", "nearest-1")


def driver_entry(name: str) -> DriverEntry:
    """Return a driver by its name in `DRIVERS` or by ``MODULE:CLASS``.

    Raises
    ------
    UsageError
        The driver is not found.
    """
    if name in DRIVERS:
        return DRIVERS[name]
    module, _, attribute = name.partition(":")
    if not all(part.isidentifier() for part in (*module.split("."), attribute)):
        raise UsageError(
            f"driver {name!r} not found; choose from {', '.join(DRIVERS)}, or give MODULE:CLASS"
        )
    if module.endswith(".py"):
        raise UsageError(f"driver {name}: give the module without .py: {module[:-3]}:{attribute}")
    found = getattr(_imported(name, module), attribute, None)
    if found is None:
        raise UsageError(f"driver {name}: {attribute!r} not found in the module {module}")
    if not callable(found):
        raise UsageError(f"driver {name}: {attribute!r} is no class; it must take the drives")
    return DriverEntry(name, "given by MODULE:CLASS", found)


def _imported(name: str, module: str) -> Any:  # noqa: ANN401 - any module
    """Import a module from the working folder or the packages; its later imports work as well."""
    folder = str(Path.cwd())
    if folder not in sys.path:
        sys.path.append(folder)
    sys.path.insert(0, folder)
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        if error.name is not None and f"{module}.".startswith(f"{error.name}."):
            raise UsageError(
                f"driver {name}: module {error.name!r} not found in {folder} or among the packages"
            ) from None
        raise UsageError(f"driver {name}: {error}") from None
    except (Exception, SystemExit) as error:  # noqa: BLE001 - whatever its code raises
        raise UsageError(f"driver {name}: {foreign_error(error)}") from None
    finally:
        sys.path.remove(folder)


def code_of(name: str) -> str:
    """Return the digest of another driver's module and of its helper modules; empty for `DRIVERS`.

    Helper modules are imported by the module, also indirectly, and lie in the working folder or in
    its package.
    """
    if name in DRIVERS:
        return ""
    module = name.partition(":")[0]
    file = getattr(_imported(name, module), "__file__", None)
    if file is None:
        return ""
    digest = hashlib.sha256(Path(file).read_bytes())
    for helper, path in sorted(_helpers(module, Path(file)).items()):
        digest.update(f"{helper}\0".encode() + path.read_bytes())
    return digest.hexdigest()


def _helpers(module: str, file: Path) -> dict[str, Path]:
    """Return the files of a module and of its helper modules by name."""
    parts = module.split(".")
    root = file.parents[len(parts) - (file.name != "__init__.py")]
    in_package = root != Path.cwd()
    waiting = [module]
    found: dict[str, Path] = {}
    while waiting:
        name = waiting.pop()
        top, *below = name.split(".")
        if name in found or top in _OURS or (in_package and top != parts[0]):
            continue
        base = root.joinpath(top, *below)
        files = (base / "__init__.py", base.with_suffix(".py"))
        path = next((one for one in files if one.is_file()), None)
        if path is not None:
            found[name] = path
            package = name if path == files[0] else name.rpartition(".")[0]
            waiting.extend(_imports(path, package))
    return found


def _imports(file: Path, package: str) -> Iterator[str]:
    """Yield the absolute names that a file of a package imports, with their packages."""
    for node in ast.walk(ast.parse(file.read_bytes())):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [one.name for one in node.names]
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".")
            above = parts[: len(parts) - node.level + 1] if node.level else []
            base = ".".join([*above, *filter(None, [node.module])])
            names = [f"{base}.{one.name}" for one in node.names]
        for name in names:
            parts = name.split(".")
            yield from (".".join(parts[: k + 1]) for k in range(len(parts)))


class CheckedDriver:
    """A driver whose errors, and invalid answers, are one line with its name.

    Parameters
    ----------
    name : str
        Name as in `driver_entry`.
    drives : sequence of Demonstration
    folder : Path
        Folder for what it learns.

    Raises
    ------
    DriverError
        The driver raises an error, or its answer is invalid; also by each method.
    """

    def __init__(self, name: str, drives: Sequence[Demonstration], folder: Path) -> None:
        self._name = name
        self._frames = sum(len(one.atoms) for one in drives)
        learn = driver_entry(name).learn
        self._driver = self._ask("teaching", lambda: learn(drives, folder))

    def _ask(self, what: str, ask: Callable[[], T]) -> T:
        try:
            # Standard output belongs to the results.
            with redirect_stdout(sys.stderr):
                return ask()
        except (Exception, SystemExit) as error:
            line = f"driver {self._name}: {what} failed: {foreign_error(error)}"
            raise DriverError(line) from error

    def _refuse(self, what: str, needs: str, got: object) -> DriverError:
        shown = " ".join(repr(got).split())
        return DriverError(f"driver {self._name}: {what} must be {needs}, got {shown:.60}")

    def reset(self, seed: int) -> None:
        """Start a new episode."""
        self._ask("reset", lambda: self._driver.reset(seed))

    def step(
        self, image: Uint8s, odometry: Sequence[float], depth: Depth | None, elapsed_s: float
    ) -> Motion:
        """Return the velocity until the next image."""
        got = self._ask("step", lambda: self._driver.step(image, odometry, depth, elapsed_s))
        try:
            velocity = np.asarray(got, dtype=float)
        except Exception:  # noqa: BLE001 - tensors have errors of their own
            velocity = np.empty(0)
        # NaN is not within the limits.
        if velocity.shape != (2,) or not (np.abs(velocity) <= 1.0).all():
            raise self._refuse("the result of step", "two numbers of -1 to 1", got)
        ahead, turn = velocity.tolist()
        return ahead, turn

    @property
    def said(self) -> Said | None:
        """Announced result."""
        said: Any = self._ask("said", lambda: self._driver.said)
        if said is None or (isinstance(said, str) and said in ("found", "not_here")):
            return cast("Said | None", said)
        raise self._refuse("said", "None, 'found' or 'not_here'", said)

    @property
    def place(self) -> PlaceEstimate | None:
        """Estimated place."""
        place = self._ask("place", lambda: self._driver.place)
        if place is None:
            return None
        try:
            frame, ahead, left, turned_rad = map(float, place)
        except Exception:  # noqa: BLE001 - tensors have errors of their own
            frame = ahead = left = turned_rad = math.nan
        if frame not in range(self._frames) or not math.isfinite(ahead + left + turned_rad):
            needs = f"None or (frame 0 to {self._frames - 1}, ahead, left, turned_rad)"
            raise self._refuse("place", needs, place)
        return PlaceEstimate(int(frame), ahead, left, turned_rad)
