"""A small plan, and findings for it as workers would hand them in, with known outcomes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from services.experiments.evaluation.plan import CONTROLLERS, JUDGED_TICKS, Criterion, Plan, Trial, WorldPlan
from services.experiments.evaluation.results import ResultStore
from services.experiments.evaluation.schedule import Unit, units
from services.experiments.evaluation.search_experiment import route_file
from services.experiments.evaluation.worker_cache import replace_file

BOTH = ("clean", "occluded")
SMALL = Plan(
    "small",
    (
        WorldPlan(
            "yard", (Criterion(1.0, 25.0), Criterion(0.5, 15.0)), drives=2, queries=1, lengths=(1, 5, 20),
            recognized=BOTH, template_frames=100, errands=("shorter way", "nobody there"),
            trials=(
                *(Trial(name, drives, 8) for drives in (1, 2) for name in CONTROLLERS),
                *(Trial("paper", 2, 8, length) for length in (1, 20)),
                *(Trial("paper", 2, 8, length, "occluded") for length in (1, 5, 20)),
                *(
                    Trial(name, 1, 8, **special)  # type: ignore[arg-type]
                    for name in ("smal", "teach-and-repeat")
                    for special in (
                        {"start": "anywhere"}, {"kidnap_tick": 50}, {"degradation": "occluded"}, {"variation": "dark"},
                    )
                ),
            ),
        ),
    ),
    patience=2.0,
    camera=(64, 48),
    omitted=("nearly everything",),
)  # fmt: skip
QUERIES = 60


def outcome(unit: Unit) -> str:
    """Say how a search ends: teach and repeat collides where frames are occluded, long sequences are slow."""
    blind = unit.text("degradation") == "occluded" and unit.text("controller") == "teach-and-repeat"
    slow = unit.text("controller") == "paper" and unit.number("length") == 20
    return "collision" if blind else "timeout" if slow else "found"


def finding(unit: Unit) -> dict[str, Any]:
    """Return what a unit found out, in the form that workers have it in."""
    if unit.kind == "teach":
        return {"drives": 1, "frames": 50, "files": []}
    if unit.kind == "learn":
        return {"frames": 250, "states": 40, "shared": 10, "files": []}
    if unit.kind == "queries":
        return {"frames": QUERIES, "files": []}
    if unit.kind == "search":
        ticks = 150 + unit.number("seed")
        found = {
            "outcome": outcome(unit), "ticks": ticks, "decisions": 100, "unknown": 2, "way": [[0.0, 0.0], [1.0, 2.0]],
            "shortest_m": 80.0, "driven_m": 100.0, "aside_rms_m": 0.5, "aside_max_m": 1.5,
            "aside_m": [1.5, 1.0, 0.5, 0.25, 0.25],
        }  # fmt: skip
        if unit["controller"] == "smal":
            found["wrong_share"] = 0.02
            if unit.number("kidnap_tick"):
                # One does not know where it is for 5 s, and one never does again.
                found["right_after_s"] = {1: 5.0, 2: None}.get(unit.number("seed"), 0.5)
        return found
    if unit.kind == "errand":
        right = "false_goal" if unit["errand"] == "nobody there" else "found"
        return {"right": right, "outcomes": [right] * 9 + ["timeout"], "driven_m": [120.0] * 10,
                "taught_m": [190.0, 130.0]}  # fmt: skip
    if unit.kind == "objective":
        points = [(3, 2.0, 0.1), (6, 1.7, 1e-2), (9, 1.68, 1e-5)]
        ours = [{"iterations": k, "objective": value, "duality_gap": gap} for k, value, gap in points]
        return {"templates": 100, "length": 5, "ours": ours, "algorithm2": [3.0, 2.0, 1.7, 1.681], "lower_bound": 1.68,
                "initial": 5.0}  # fmt: skip
    return recognition(unit)


def recognition(unit: Unit) -> dict[str, Any]:
    """Every third answer of a single image is wrong where frames are occluded; all others are right."""
    ticks = JUDGED_TICKS * (np.arange(QUERIES) + 1) - 1
    answered = ticks >= unit.number("length") - 1
    wrong = np.zeros(QUERIES, dtype=bool)
    if unit.number("length") == 1 and unit.text("degradation") == "occluded":
        wrong[::3] = True
    right = answered & ~wrong
    score = np.where(answered, 1.0 - 0.5 * wrong - np.arange(QUERIES) / 1000, 0.0)
    return {
        "score": score.tolist(),
        "answered": answered.astype(int).tolist(),
        "apart_m": np.where(answered, 0.1 + 5.0 * wrong, -1.0).tolist(),
        "right": [right.astype(int).tolist()] * 2,
        "findable": [[1] * QUERIES] * 2,
    }


def finished(folder: Path) -> tuple[list[Unit], ResultStore]:
    """Return a store in which all units of the small plan are done."""
    planned = units(SMALL)
    store = ResultStore(folder, SMALL)
    for unit in planned:
        store.add(unit, finding(unit), 0.5)
    picture = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    _, data = cv2.imencode(".jpg", picture)
    ticks = np.arange(0, 151, 10)
    poses = np.column_stack([np.linspace(0, 10, 152), np.linspace(0, 5, 152), np.zeros(152)])
    arrays = {"poses": poses, "ticks": ticks} | {f"picture_{tick}": data for tick in ticks}
    replace_file(store.work / route_file("yard", 1), arrays.items())
    return planned, store
