"""One unit of work, done in the process of a worker."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from services.experiments.evaluation.demonstrations import drive, save_drive
from services.experiments.evaluation.multi_drive_tasks import run_errand
from services.experiments.evaluation.objective_experiment import objectives
from services.experiments.evaluation.plan import DEFAULT_LENGTH, ERRANDS, RUN_SEED, Plan, Recognizer, Trial
from services.experiments.evaluation.recognition_experiment import judged, make_queries, recognize
from services.experiments.evaluation.schedule import Unit
from services.experiments.evaluation.search_experiment import Drivers, run_search
from services.experiments.evaluation.worker_cache import Workplace, map_file, model_file, query_file, teach_file
from smal.mapping import learn as learn_map
from smal.paper.learning import LearningSettings, learn


class Work:
    """Does units of a plan, one after another.

    Parameters
    ----------
    plan
    folder
        ``work`` of the results.
    """

    def __init__(self, plan: Plan, folder: Path) -> None:
        self._worlds = {one.world: one for one in plan.worlds}
        self._place = Workplace(folder, plan.camera)
        self._drivers = Drivers(self._place)

    def do(self, unit: Unit) -> tuple[dict[str, Any], float]:
        """Return what a unit found out, and the seconds of processor time that it took."""
        kinds: dict[str, Callable[[Unit], dict[str, Any]]] = {
            "teach": self._teach,
            "learn": self._learn,
            "queries": self._queries,
            "recognize": self._recognize,
            "objective": self._objective,
            "search": self._search,
            "errand": self._errand,
        }
        began_s = time.process_time()
        finding = kinds[unit.kind](unit)
        return finding, time.process_time() - began_s

    def _teach(self, unit: Unit) -> dict[str, Any]:
        simulation, features, seed = self._place.simulation(unit.world, None), self._place.features, unit.number("seed")
        made = drive(simulation, features, seed)
        if made is None:
            raise ValueError(f"the expert's drive with seed {seed} in {unit.world} did not reach the victim")
        name = teach_file(unit.world, seed)
        save_drive(self._place.folder / name, made, features)
        return {"drives": 1, "frames": len(made.poses), "files": [name]}

    def _learn(self, unit: Unit) -> dict[str, Any]:
        count = unit.number("drives")
        drives = self._place.drives(unit.world, count)
        length = unit.number("length")
        settings = LearningSettings(features=self._place.features, sequence_length=length, novelty="weight")
        demonstrations = [one.demonstration for one in drives]
        model, report = learn(demonstrations, settings)
        files = [model_file(unit.world, count, length)]
        model.save(self._place.folder / files[0])
        # One map, which does not depend on l.
        if length == DEFAULT_LENGTH:
            files.append(map_file(unit.world, count))
            learn_map(demonstrations, self._place.features).save(self._place.folder / files[1])
        return {"frames": report.frames, "states": report.states, "shared": report.shared_states, "files": files}

    def _queries(self, unit: Unit) -> dict[str, Any]:
        # The query of the objective is a clear one.
        degradations = tuple(dict.fromkeys(("clean", *self._worlds[unit.world].recognized)))
        return make_queries(self._place, unit.world, unit.number("seed"), degradations)

    def _recognize(self, unit: Unit) -> dict[str, Any]:
        method, drives = unit.text("method"), unit.number("drives")
        recognizer = Recognizer(method, unit.number("length"))  # type: ignore[arg-type]  # of this plan
        degradation, seed = unit.text("degradation"), unit.number("seed")
        matches, true = recognize(self._place, unit.world, drives, recognizer, degradation, seed)
        return judged(matches, self._place.poses(unit.world, drives), true, self._worlds[unit.world].criteria)

    def _objective(self, unit: Unit) -> dict[str, Any]:
        model = self._place.model(unit.world, unit.number("drives"), unit.number("length"))
        with np.load(self._place.folder / query_file(unit.world, unit.number("seed")), allow_pickle=False) as held:
            views = held["features_clean"]
        return objectives(model, views, unit.number("templates"))

    def _errand(self, unit: Unit) -> dict[str, Any]:
        (errand,) = (one for one in ERRANDS if one == unit["errand"])
        return run_errand(self._place, unit.world, errand, range(RUN_SEED, RUN_SEED + unit.number("runs")))

    def _search(self, unit: Unit) -> dict[str, Any]:
        trial = Trial(
            unit.text("controller"),
            unit.number("drives"),
            1,
            unit.number("length"),
            unit.text("degradation"),
            unit.text("variation"),
            "anywhere" if unit["start"] == "anywhere" else "start",
            unit.number("kidnap_tick"),
        )
        (criterion, *_), patience = self._worlds[unit.world].criteria, float(unit["patience"])
        return run_search(self._place, self._drivers, unit.world, trial, unit.number("seed"), criterion, patience)
