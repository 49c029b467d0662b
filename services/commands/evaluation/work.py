"""One unit of work, done in the process of a worker."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from services.commands.evaluation.demonstrations import demonstrate, save_drives
from services.commands.evaluation.objective_experiment import objectives
from services.commands.evaluation.plan import DEFAULT_LENGTH, Plan, Recogniser
from services.commands.evaluation.recognition_experiment import judged, make_queries, recognise
from services.commands.evaluation.search_experiment import Drivers, run_search
from services.commands.evaluation.units import Unit
from services.commands.evaluation.workplace import Workplace, model_file, query_file, teach_file
from smal.learning import LearningSettings, learn


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
            "recognise": self._recognise,
            "objective": self._objective,
            "search": self._search,
        }
        began_s = time.process_time()
        finding = kinds[unit.kind](unit)
        return finding, time.process_time() - began_s

    def _teach(self, unit: Unit) -> dict[str, Any]:
        simulation, features = self._place.simulation(unit.world, None), self._place.features
        count, is_recovery = unit.number("count"), unit.text("purpose") == "recovery"
        drives, recoveries = (0, count) if is_recovery else (count, 0)
        kept = demonstrate(simulation, features, drives, recoveries, unit.number("seed"), thumbnails=True)
        save_drives(self._place.folder / teach_file(unit), kept, features)
        frames = sum(len(one.poses) for one in kept)
        return {"drives": len(kept), "frames": frames, "files": [teach_file(unit)]}

    def _learn(self, unit: Unit) -> dict[str, Any]:
        drives = self._place.drives(unit.world, unit.text("teaching"))
        length = unit.number("length")
        # The paper's test for new states; and one map, which does not depend on l.
        settings = LearningSettings(
            features=self._place.features, sequence_length=length, novelty="weight", map_views=length == DEFAULT_LENGTH
        )
        model, report = learn([one.demonstration for one in drives], settings)
        name = model_file(unit.world, unit.text("teaching"), length)
        model.save(self._place.folder / name)
        return {"frames": report.frames, "states": report.states, "shared": report.shared_states, "files": [name]}

    def _queries(self, unit: Unit) -> dict[str, Any]:
        # The query of the objective is a clear one.
        degradations = tuple(dict.fromkeys(("clean", *self._worlds[unit.world].recognised)))
        return make_queries(self._place, unit.world, unit.number("seed"), degradations)

    def _recognise(self, unit: Unit) -> dict[str, Any]:
        method, teaching = unit.text("method"), unit.text("teaching")
        recogniser = Recogniser(method, unit.number("length"))  # type: ignore[arg-type]  # of this plan
        degradation, seed = unit.text("degradation"), unit.number("seed")
        matches, true = recognise(self._place, unit.world, teaching, recogniser, degradation, seed)
        return judged(matches, self._place.poses(unit.world, teaching), true, self._worlds[unit.world].criteria)

    def _objective(self, unit: Unit) -> dict[str, Any]:
        model = self._place.model(unit.world, unit.text("teaching"), unit.number("length"))
        with np.load(self._place.folder / query_file(unit.world, unit.number("seed")), allow_pickle=False) as held:
            views = held["features_clean"]
        return objectives(model, views, unit.number("templates"))

    def _search(self, unit: Unit) -> dict[str, Any]:
        return run_search(
            self._place,
            self._drivers,
            world=unit.world,
            teaching=unit.text("teaching"),
            controller=unit.text("controller"),
            length=unit.number("length"),
            degradation=unit.text("degradation"),
            seed=unit.number("seed"),
            max_ticks=unit.number("max_ticks"),
        )
