"""A small plan, and findings for it as workers would hand them in, with known outcomes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from services.experiments.evaluation.drives import save_arrays
from services.experiments.evaluation.plan import CONTROLLERS, JUDGED_TICKS, Criterion, Plan, Trial, WorldPlan
from services.experiments.evaluation.results import Results, file_of
from services.experiments.evaluation.units import Unit, units
from services.experiments.evaluation.work import is_example

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
    blind = unit["degradation"] == "occluded" and unit["controller"] == "teach-and-repeat"
    slow = unit["controller"] == "paper" and unit["length"] == 20
    return "collision" if blind else "timeout" if slow else "found"


def finding(unit: Unit) -> dict[str, Any]:
    """Return what a unit found out, in the form that workers have it in."""
    if unit.kind == "teach":
        return {"frames": 50}
    if unit.kind == "learn":
        return {"states": 40} if unit["length"] else {}
    if unit.kind == "queries":
        return {"frames": QUERIES}
    if unit.kind == "search":
        ticks = 150 + unit["seed"]
        found = {
            "outcome": outcome(unit), "ticks": ticks, "file": is_example(unit) and unit["seed"] == 1,
            "way": [[0.0, 0.0], [1.0, 2.0]],
            "shortest_m": 80.0, "driven_m": 100.0, "aside_rms_m": 0.5, "aside_max_m": 1.5,
            "aside_m": [1.5, 1.0, 0.5, 0.25, 0.25],
        }  # fmt: skip
        if unit["controller"] == "smal":
            found["wrong_share"] = 0.02
            if unit["kidnap_tick"]:
                # One does not know where it is for 5 s, and one never does again.
                found["right_after_s"] = {1: 5.0, 2: None}.get(unit["seed"], 0.5)
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
    answered = ticks >= unit["length"] - 1
    wrong = np.zeros(QUERIES, dtype=bool)
    if unit["length"] == 1 and unit["degradation"] == "occluded":
        wrong[::3] = True
    right = answered & ~wrong
    score = np.where(answered, 1.0 - 0.5 * wrong - np.arange(QUERIES) / 1000, 0.0)
    return {
        "score": score.tolist(),
        "answered": answered.astype(int).tolist(),
        "right": [right.astype(int).tolist()] * 2,
        "findable": [[1] * QUERIES] * 2,
    }


def finished(folder: Path) -> Results:
    """Return results in which all units of the small plan are done."""
    results = Results(folder, units(SMALL))
    picture = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    _, data = cv2.imencode(".jpg", picture)
    ticks = np.arange(0, 151, 10)
    poses = np.column_stack([np.linspace(0, 10, 152), np.linspace(0, 5, 152), np.zeros(152)])
    for unit in units(SMALL):
        found = finding(unit) | {"cpu_s": 0.5}
        if found.get("file"):
            pictures = {f"picture_{tick}": data for tick in ticks}
            save_arrays(file_of(results.work, unit), poses=poses, ticks=ticks, **pictures)
        results.add(unit, found)
    return results
