"""A small plan, and findings for it as workers would hand them in, with known outcomes."""

from pathlib import Path

import cv2
import numpy as np

from services.experiments.evaluation.drivers import DEFAULT_LENGTH
from services.experiments.evaluation.drives import save_arrays
from services.experiments.evaluation.plan import (
    JUDGED_TICKS,
    Criterion,
    EvaluationPlan,
    Trial,
    WorldPlan,
)
from services.experiments.evaluation.results import Results
from services.experiments.evaluation.units import (
    Finding,
    LearnUnit,
    Query,
    Recognize,
    Searches,
    TaskSearches,
    Teach,
    TeachDriver,
    Unit,
    units,
)

#: Drivers of every kind.
DRIVERS = (
    "smal", "smal-waits", "smal-unguarded", "teach-and-repeat", "teach-and-repeat-told", "place-filter", "nearest-1",
    "nearest-5", f"paper-{DEFAULT_LENGTH}",
)  # fmt: skip

SMALL = EvaluationPlan(
    "small",
    (
        WorldPlan(
            "yard", Criterion(1.0, 25.0), drives=2, queries=1, lengths=(1, 5, 20),
            recognized=("clean", "occluded"), tasks=True,
            trials=(
                *(Trial(name, drives, 8) for drives in (1, 2) for name in DRIVERS),
                *(
                    Trial(f"paper-{length}", 2, 8, degradation=view)
                    for length in (1, 20)
                    for view in ("clean", "occluded")
                ),
                *(
                    Trial(name, 1, 8, **special)  # type: ignore[arg-type]
                    for name in ("smal", "teach-and-repeat")
                    for special in ({"start": "anywhere", "sets": 2}, {"kidnap_tick": 50}, {"degradation": "occluded"})
                ),
            ),
        ),
    ),
    patience=2.0,
    camera=(64, 48),
    omitted=("nearly everything",),
)  # fmt: skip
QUERIES = 60  # Judged frames of the held-out drive.


def finding(unit: Unit) -> Finding:
    """Return what a unit found out, in the form that workers have it in."""
    match unit:
        case Teach():
            return {"frames": 50}
        case LearnUnit():
            return {"states": 40}
        case TeachDriver():
            return {}
        case Query():
            return {"frames": QUERIES}
        case Searches():
            seeds = range(1 + unit.which, 9, unit.trial.sets)
            return {
                "searches": [search(unit.trial, seed) for seed in seeds],
                "file": unit.is_example,
                "decision_ms": [10.0, 20.0, 30.0],
            }
        case TaskSearches():
            outcomes = ["found"] * 9 + ["timeout"]
            return {"outcomes": outcomes, "driven_m": [120.0] * 10, "taught_m": [190.0, 130.0]}
        case Recognize():
            return {"queries": [recognition(unit)]}
    raise TypeError(unit)


def search(trial: Trial, seed: int) -> Finding:
    """Let teach and repeat collide where frames are occluded, and long sequences be slow."""
    blind = trial.degradation == "occluded" and trial.driver == "teach-and-repeat"
    slow = trial.length == 20
    found = {
        "outcome": "collision" if blind else "timeout" if slow else "found", "right": None, "ticks": 150 + seed,
        "shortest_m": 80.0, "driven_m": 100.0, "aside_rms_m": 0.5, "aside_max_m": 1.5,
        "clearance_p5_m": 0.3 + 0.1 * (seed % 2), "turns": 20, "jerk_m_s3": 2.0, "taught_ticks": 120.0,
        "arrival_m": 0.5 * seed, "sure_share": 0.0, "wrong_share": 0.0,
    }  # fmt: skip
    if trial.driver == "smal":
        found |= {"sure_share": 1.0, "wrong_share": 0.02}
        if trial.kidnap_tick:
            # One does not know where it is for 5 s, and one never does again.
            found["right_after_s"] = {1: 5.0, 2: None}.get(seed, 0.5)
    return found


def recognition(unit: Recognize) -> Finding:
    """Every third answer of a single image is wrong where frames are occluded; all others are right."""
    ticks = JUDGED_TICKS * (np.arange(QUERIES) + 1) - 1
    answered = ticks >= unit.recognizer.length - 1
    wrong = np.zeros(QUERIES, dtype=bool)
    if unit.recognizer.eq9 and unit.recognizer.length == 1 and unit.degradation == "occluded":
        wrong[::3] = True
    right = answered & ~wrong
    score = np.where(answered, 1.0 - 0.5 * wrong - np.arange(QUERIES) / 1000, 0.0)
    return {
        "tick": ticks.tolist(),
        "score": score.tolist(),
        "answered": answered.astype(int).tolist(),
        "right": right.astype(int).tolist(),
        "findable": [1] * QUERIES,
    }


def finished(folder: Path) -> Results:
    """Return results in which all units of the small plan are done."""
    results = Results(folder, units(SMALL))
    picture = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    _, data = cv2.imencode(".jpg", picture)
    poses = np.column_stack([np.linspace(0, 10, 152), np.linspace(0, 5, 152), np.zeros(152)])
    for unit in units(SMALL):
        found = finding(unit) | {"cpu_s": 0.5}
        if found.get("file"):
            pictures = {str(tick): data for tick in range(0, 151, 10)}
            save_arrays(unit.file(results.work), poses=poses, **pictures)
        results.add(unit, found)
    return results
