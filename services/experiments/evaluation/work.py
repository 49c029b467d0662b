"""What the units of an evaluation do, a function a kind: from a unit, and files of those it needs, to a finding."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from schemas.rpc import ResetRequest
from services.experiments.evaluation.degradation import DEGRADATIONS, Degrader
from services.experiments.evaluation.drives import Drive, drive, load_arrays, load_drive, save_arrays, save_drive
from services.experiments.evaluation.errands import run_errand
from services.experiments.evaluation.objective import objectives
from services.experiments.evaluation.plan import DEFAULT_LENGTH, RUN_SEED, Criterion
from services.experiments.evaluation.recognition import FEATURES, judged, query_drive, recognize
from services.experiments.evaluation.results import file_of
from services.experiments.evaluation.search import PICTURE_TICKS, Driver, finding, search
from services.experiments.evaluation.units import Unit
from services.kit.jpeg import encode_jpeg
from services.simulator.camera import FIELD_OF_VIEW_DEG, CameraSettings
from services.simulator.simulation import Simulation, open_simulation
from smal.evaluation.baselines.nearest_neighbour_imitation import NearestNeighbourImitation
from smal.evaluation.baselines.seqslam_localization import SeqSlamImitation
from smal.evaluation.baselines.teach_and_repeat import TeachAndRepeat
from smal.mapping import learn as learn_map
from smal.model import Model
from smal.paper.learning import LearningSettings, learn
from smal.paper.model import Model as PaperModel
from smal.paper.robot import Robot as PaperRobot
from smal.robot import Robot

Found = dict[str, Any]


def do(unit: Unit, folder: Path) -> Found:
    """Return what a unit found out, and its processor time; its file, if it leaves one, is in the folder."""
    began_s = time.process_time()
    found = KINDS[unit.kind](unit, folder)
    return found | {"cpu_s": round(time.process_time() - began_s, 3)}


# What a worker keeps open from one unit to the next: two worlds at most are at work at a time, and a model with its
# inner products may take a gigabyte.


@lru_cache(maxsize=4)
def simulation_in(world: str, camera: tuple[int, int], shake: float | None, variation: str) -> Simulation:
    """Open a world."""
    return open_simulation(world, CameraSettings(*camera), shake=shake, variation=variation)


@lru_cache(maxsize=1)
def _drives(units: tuple[Unit, ...], folder: Path) -> tuple[Drive, ...]:
    return tuple(load_drive(file_of(folder, unit)) for unit in units)


@lru_cache(maxsize=2)
def _model(unit: Unit, folder: Path) -> Model | PaperModel:
    return (PaperModel if unit["length"] else Model).load(file_of(folder, unit))


@lru_cache(maxsize=2)
def _driver(controller: str, needs: tuple[Unit, ...], folder: Path) -> Driver:
    """Return who drives in a search."""
    learned = [_model(unit, folder) for unit in needs if unit.kind == "learn"]
    if learned:
        return PaperRobot(learned[0]) if isinstance(learned[0], PaperModel) else Robot(learned[0])
    taught = [one.demonstration for one in _drives(needs, folder)]
    if controller == "teach-and-repeat":
        return TeachAndRepeat(taught, math.radians(FIELD_OF_VIEW_DEG))
    if controller == "seqslam":
        return SeqSlamImitation(taught)
    return NearestNeighbourImitation(taught, FEATURES, int(controller.removeprefix("nearest-")))


def _taught(unit: Unit, folder: Path) -> tuple[Drive, ...]:
    return _drives(tuple(one for one in unit.needs if one.kind == "teach"), folder)


def _teach(unit: Unit, folder: Path) -> Found:
    made = drive(simulation_in(unit["world"], unit["camera"], None, "day"), FEATURES, unit["seed"])
    save_drive(file_of(folder, unit), made)
    return {"frames": len(made.poses), "file": True}


def _learn(unit: Unit, folder: Path) -> Found:
    demonstrations = [one.demonstration for one in _taught(unit, folder)]
    if not unit["length"]:
        learn_map(demonstrations, FEATURES).save(file_of(folder, unit))
        return {"file": True}
    settings = LearningSettings(features=FEATURES, sequence_length=unit["length"])
    model, report = learn(demonstrations, settings)
    model.save(file_of(folder, unit))
    return {"states": report.states, "file": True}


def _queries(unit: Unit, folder: Path) -> Found:
    named = {name: DEGRADATIONS[name] for name in unit["degradations"]}
    arrays: dict[str, Any] = {}
    # Shake moves the camera and not the robot: the way is the same.
    for shake in dict.fromkeys(how.shake for how in named.values()):
        views = {name: how for name, how in named.items() if how.shake == shake}
        arrays |= query_drive(simulation_in(unit["world"], unit["camera"], shake, "day"), unit["seed"], views)
    save_arrays(file_of(folder, unit), **arrays)
    return {"frames": len(arrays["poses"]), "file": True}


def _recognize(unit: Unit, folder: Path) -> Found:
    taught, query = _taught(unit, folder), load_arrays(file_of(folder, unit.needs[-1]))
    model = next((_model(one, folder) for one in unit.needs if one.kind == "learn"), None)
    assert not isinstance(model, Model)  # noqa: S101 - of the paper
    features = "seqslam" if unit["method"] == "seqslam" else "features"
    matches = recognize(unit["method"], unit["length"], model, taught, query[f"{features}_{unit['degradation']}"])
    criteria = [Criterion(*each) for each in unit["criteria"]]
    return judged(matches, np.concatenate([one.poses for one in taught]), query["poses"], criteria)


def _objective(unit: Unit, folder: Path) -> Found:
    learned, query = unit.needs
    model = _model(learned, folder)
    assert isinstance(model, PaperModel)  # noqa: S101
    assert learned["length"] == DEFAULT_LENGTH  # noqa: S101
    return objectives(model, load_arrays(file_of(folder, query))["features_clean"], unit["templates"])


def _search(unit: Unit, folder: Path) -> Found:
    taught, how = _taught(unit, folder), DEGRADATIONS[unit["degradation"]]
    patience = round(unit["patience"] * max(len(one.poses) for one in taught))
    request = ResetRequest(
        seed=unit["seed"], purpose="run", start=unit["start"], kidnap_tick=unit["kidnap_tick"] or None,
        max_ticks=patience,
    )  # fmt: skip
    shown = is_example(unit)
    needs = tuple(one for one in unit.needs if one.kind == "learn") or unit.needs
    found = search(
        simulation_in(unit["world"], unit["camera"], how.shake, unit["variation"]),
        _driver(unit["controller"], needs, folder),
        request,
        Degrader(how, unit["seed"]),
        lambda tick: shown and tick % PICTURE_TICKS == 0,
    )
    said = finding(found, np.concatenate([one.poses for one in taught]), Criterion(*unit["criterion"]))
    if shown:
        pictures = {f"picture_{tick}": np.frombuffer(encode_jpeg(image), np.uint8)
                    for tick, image in found.pictures.items()}  # fmt: skip
        save_arrays(file_of(folder, unit), poses=found.poses, ticks=np.array(sorted(found.pictures)), **pictures)
    return said | {"file": shown}


def is_example(unit: Unit) -> bool:
    """Whether pictures of a search are kept: SMAL's after one drive, from the start, as it was taught."""
    usual = {"controller": "smal", "drives": 1, "degradation": "clean", "variation": "day", "start": "start",
             "kidnap_tick": 0}  # fmt: skip
    return unit.kind == "search" and all(unit[name] == value for name, value in usual.items())


def _errand(unit: Unit, _folder: Path) -> Found:
    seeds = range(RUN_SEED, RUN_SEED + unit["runs"])
    return run_errand(unit["world"], CameraSettings(*unit["camera"]), unit["errand"], seeds)


KINDS: Final[dict[str, Callable[[Unit, Path], Found]]] = {
    "teach": _teach,
    "learn": _learn,
    "queries": _queries,
    "recognize": _recognize,
    "objective": _objective,
    "search": _search,
    "errand": _errand,
}
