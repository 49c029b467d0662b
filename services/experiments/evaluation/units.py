"""Units of work of a plan: each is a pure function of its fields and of the units that it needs."""

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from schemas.episode import Purpose
from schemas.rpc import ResetRequest
from services.experiments.engine import digest_of
from services.experiments.evaluation import recognition
from services.experiments.evaluation.degradation import DEGRADATIONS, Degrader
from services.experiments.evaluation.drivers import FEATURES, CheckedDriver, code_of
from services.experiments.evaluation.drives import (
    drive,
    drive_of,
    load_arrays,
    save_arrays,
)
from services.experiments.evaluation.plan import (
    CLOUDS_SEED,
    QUERY_SEED,
    RUN_SEED,
    RUNS,
    TEACHING_SEED,
    Criterion,
    EvaluationPlan,
    RecognizerName,
    Trial,
    WorldPlan,
)
from services.experiments.evaluation.search import PICTURE_TICKS, finding, search
from services.experiments.evaluation.tasks import TASKS, run_task
from services.kit.jpeg import encode_jpeg
from services.simulator.opening import BaseKind, open_simulation
from services.simulator.sensors.camera import CameraSettings
from services.simulator.simulation import Simulation
from services.simulator.variation import clouded
from smal.evaluation.nearest import recognize_nearest
from smal.features import Centering
from smal.paper.learning import LearningSettings, learn
from smal.paper.model import PaperModel
from smal.teaching.demonstration import Demonstration

# Numbers, texts and lists; ``cpu_s`` is the processor time.
Finding = dict[str, Any]
U = TypeVar("U", bound="Unit")
# Settings of the simulator in a trial.
_ASKED: Final = (
    "start",
    "victim",
    "obstacles",
    "people",
    "blocked",
)
# Files that results depend on; the report is not one of them.
_SOURCES: Final = (
    "smal/**/*.py", "services/simulator/**/*", "services/robot/*.py", "services/expert/*.py",
    "services/experiments/evaluation/*.py",
)  # fmt: skip


@cache
def code_fingerprint() -> str:
    """Return the digest of the code, the shaders and the worlds that results depend on."""
    return digest_of(_SOURCES)


@dataclass(frozen=True)
class Site:
    """A world with the content of its file (equal names can be different maps), and the robot."""

    world: str
    content: str
    camera: tuple[int, int]
    base: BaseKind = "physics"

    @classmethod
    def of(cls, world: str, camera: tuple[int, int], base: BaseKind) -> "Site":
        """Return the site of a world by name or path."""
        path = Path(world)
        return cls(
            world,
            hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "",
            camera,
            base,
        )


@dataclass(frozen=True)
class Unit(ABC):
    """Work that any process can do once; the files of the units in ``needs`` are its input."""

    site: Site
    needs: tuple["Unit", ...]

    @property
    def name(self) -> str:
        """Name of the result files; changes with fields, needs and the version of the code."""
        return hashlib.sha256(f"{code_fingerprint()} {self!r}".encode()).hexdigest()[:24]

    def file(self, folder: Path) -> Path:
        """Return the path of the file for other units."""
        return folder / f"{self.name}.data"

    @abstractmethod
    def do(self, folder: Path) -> Finding:
        """Do the work and return the result; ``file`` tells whether there is a file."""

    def needed(self, kind: type[U]) -> tuple[U, ...]:
        """Return the needed units of one type."""
        return tuple(one for one in self.needs if isinstance(one, kind))


# Kept open by a worker between units: at most two worlds are in use, and a model with its inner
# products can take a gigabyte.


@lru_cache(maxsize=4)
def simulation_in(
    site: Site,
    shake: float | None = None,
    variation: str = "day",
    clouds_seed: int | None = None,
    depth: bool = False,
    moved_camera: bool = False,
) -> Simulation:
    """Open a world."""
    camera = CameraSettings(*site.camera)
    if moved_camera:
        # It was knocked since teaching: it looks down, sits higher, and shows less.
        camera = replace(camera, pitch_deg=5.0, raised_m=0.1, zoom=1.05)
    return open_simulation(
        site.world,
        camera,
        base=site.base,
        shake=shake,
        variation=variation if clouds_seed is None else clouded(variation, clouds_seed),
        depth=depth,
    )


@lru_cache(maxsize=1)
def _drives(
    units: tuple["Teach", ...], folder: Path
) -> tuple[list[Demonstration], list[NDArray[np.float64]]]:
    """Return the drives, and their true poses (f, 3), metres and radians, for evaluation only."""
    held = [load_arrays(unit.file(folder)) for unit in units]
    return [drive_of(one) for one in held], [one["poses"] for one in held]


@lru_cache(maxsize=2)
def _paper_model(unit: "LearnUnit", folder: Path) -> PaperModel:
    return PaperModel.load(unit.file(folder))


@lru_cache(maxsize=2)
def _taught(unit: "TeachDriver", folder: Path) -> CheckedDriver:
    return unit.taught(folder)


@dataclass(frozen=True)
class Teach(Unit):
    """Drive with the expert."""

    seed: int
    purpose: Purpose = "drive"

    def do(self, folder: Path) -> Finding:
        """Save the drive."""
        made = drive(simulation_in(self.site), FEATURES, self.seed, purpose=self.purpose)
        save_arrays(self.file(folder), **made)
        return {"frames": len(made["poses"]), "file": True}


@dataclass(frozen=True)
class LearnUnit(Unit):
    """Learn a model of the paper, for recognition."""

    length: int

    def do(self, folder: Path) -> Finding:
        """Save the model."""
        demonstrations, _ = _drives(self.needed(Teach), folder)
        model = learn(
            demonstrations, LearningSettings(features=FEATURES, sequence_length=self.length)
        )
        model.save(self.file(folder))
        return {"states": model.states, "file": True}


@dataclass(frozen=True)
class TeachDriver(Unit):
    """Teach a driver once, for all its searches after these drives."""

    driver: str
    code: str  # Digest of the driver's own module.

    def do(self, folder: Path) -> Finding:
        """Let the driver learn and save what it wants to keep."""
        self.taught(folder)
        return {}

    def taught(self, folder: Path) -> CheckedDriver:
        """Return the driver after these drives."""
        own = folder / f"{self.name}.driver"
        own.mkdir(exist_ok=True)
        drives, _ = _drives(self.needed(Teach), folder)
        return CheckedDriver(self.driver, list(drives), own)


@dataclass(frozen=True)
class Query(Unit):
    """Drive a held-out way and compute features under every degradation."""

    degradations: tuple[str, ...]
    seed: int

    def do(self, folder: Path) -> Finding:
        """Save the features of all views."""
        arrays: dict[str, Any] = {}
        # Shake moves the camera and not the robot, so the route is the same.
        for shake in dict.fromkeys(DEGRADATIONS[name].shake for name in self.degradations):
            views = {
                name: DEGRADATIONS[name]
                for name in self.degradations
                if DEGRADATIONS[name].shake == shake
            }
            arrays |= recognition.query_drive(
                simulation_in(self.site, shake), FEATURES, self.seed, views
            )
        save_arrays(self.file(folder), **arrays)
        return {"frames": len(arrays["poses"]), "file": True}


@dataclass(frozen=True)
class Recognize(Unit):
    """Recognize the frames of held-out drives with a method."""

    recognizer: RecognizerName
    degradation: str
    criterion: Criterion

    def do(self, folder: Path) -> Finding:
        """Evaluate the answers for each drive."""
        taught, poses = _drives(self.needed(Teach), folder)
        found = []
        for query in self.needed(Query):
            held = load_arrays(query.file(folder))
            views = held[self.degradation]
            if self.recognizer.eq9:
                matches = recognition.recognize_states(
                    _paper_model(*self.needed(LearnUnit), folder), views
                )
            else:
                centering = Centering.fit([one.rows for one in taught], FEATURES)
                drives = [centering.apply(one.rows) for one in taught]
                matches = recognize_nearest(drives, centering.apply(views), self.recognizer.length)
            demonstrated = np.concatenate(poses)
            found.append(recognition.judged(matches, demonstrated, held["poses"], self.criterion))
        return {"queries": found}


@dataclass(frozen=True)
class Searches(Unit):
    """Searches of one driver, taught by one of a trial's sets of drives, under one condition."""

    trial: Trial
    which: int
    patience: float
    criterion: Criterion

    @property
    def is_example(self) -> bool:
        """Whether to keep pictures: SMAL after one drive, from the start, as taught."""
        return self.which == 0 and self.trial == Trial(
            "smal", 1, self.trial.runs, sets=self.trial.sets
        )

    def do(self, folder: Path) -> Finding:
        """Search with each seed; save the pictures of the first successful search of an example."""
        _, poses = _drives(self.needed(Teach), folder)
        how = DEGRADATIONS[self.trial.degradation]
        trial = self.trial
        simulation = simulation_in(
            self.site,
            how.shake,
            trial.variation,
            CLOUDS_SEED + self.which,  # The clouds always differ from those in teaching.
            trial.hindered and trial.entry.guarded,
            trial.moved_camera,
        )
        (learned,) = self.needed(TeachDriver)
        driver = _taught(learned, folder)
        taught_poses = np.concatenate(poses)
        frames = [len(one) for one in poses]
        taught_ticks = float(np.mean(frames)) - 1.0
        most_ticks = round(self.patience * max(frames))
        asked: dict[str, Any] = {name: getattr(trial, name) for name in _ASKED}
        found = []
        decision_ms = list[float]()
        shown = False
        for seed in range(RUN_SEED + self.which, RUN_SEED + trial.runs, trial.sets):
            request = ResetRequest(
                seed=seed,
                purpose="run",
                max_ticks=most_ticks,
                kidnap_tick=trial.kidnap_tick or None,
                until_said=True,
                **asked,
            )
            keeps = self.is_example and not shown
            pictures = PICTURE_TICKS if keeps else 0
            one = search(simulation, driver, request, Degrader(how, seed), pictures)
            found.append(
                finding(one, taught_poses, self.criterion) | {"taught_ticks": taught_ticks}
            )
            decision_ms += one.decision_ms.round(2).tolist()
            if keeps and one.outcome == "found":
                shown = True
                jpegs = {
                    str(k): np.frombuffer(encode_jpeg(seen), np.uint8)
                    for k, seen in one.pictures.items()
                }
                save_arrays(self.file(folder), poses=one.poses, **jpegs)
        return {"searches": found, "file": shown, "decision_ms": decision_ms}


@dataclass(frozen=True)
class TaskSearches(Unit):
    """Searches of one task that needs several drives."""

    task: str
    runs: int

    def do(self, folder: Path) -> Finding:
        """See `run_task`."""
        del folder
        seeds = range(RUN_SEED, RUN_SEED + self.runs)
        return run_task(
            self.site.world, CameraSettings(*self.site.camera), FEATURES, self.task, seeds
        )


def units(plan: EvaluationPlan) -> list[Unit]:
    """Return all units of a plan, each after the units that it needs, the most informative first."""
    found: dict[Unit, None] = {}

    def add(unit: Unit) -> None:
        for needed in unit.needs:
            add(needed)
        found[unit] = None

    for world in plan.worlds:
        site = Site.of(world.world, plan.camera, plan.base)
        for unit in (*_searches(site, world, plan.patience), *_recognitions(site, world)):
            add(unit)
        for task in TASKS if world.tasks else ():
            add(TaskSearches(site, (), task, RUNS))
    return list(found)


def _searches(site: Site, world: WorldPlan, patience: float) -> Iterator[Unit]:
    for trial in world.trials:
        for which in range(trial.sets):
            drives = _teaching(site, trial.drives, which, trial.recoveries)
            taught = TeachDriver(site, drives, trial.driver, code_of(trial.driver))
            yield Searches(site, (*drives, taught), trial, which, patience, world.criterion)


def _recognitions(site: Site, world: WorldPlan) -> Iterator[Unit]:
    queries = tuple(Query(site, (), world.recognized, QUERY_SEED + k) for k in range(world.queries))
    taught = _teaching(site, world.drives)
    for recognizer in world.recognizers if queries else ():
        model = (LearnUnit(site, taught, recognizer.length),) if recognizer.eq9 else ()
        for name in world.recognized:
            needs = (*taught, *queries, *model)
            yield Recognize(site, needs, recognizer, name, world.criterion)


def _teaching(site: Site, drives: int, which: int = 0, recoveries: int = 0) -> tuple[Teach, ...]:
    first = TEACHING_SEED + which * drives
    return (
        *(Teach(site, (), first + k) for k in range(drives)),
        *(Teach(site, (), first + k, "recovery") for k in range(recoveries)),
    )
