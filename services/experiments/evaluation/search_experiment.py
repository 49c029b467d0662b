"""Searches of SMAL and of its peers, as numbers that JSON knows, and with pictures for the example route."""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from services.experiments.evaluation.controllers import (
    Controller,
    FilterController,
    ImitationController,
    PaperController,
    Place,
    SeqSlamController,
    TeachAndRepeatController,
)
from services.experiments.evaluation.degradation import degradation_named
from services.experiments.evaluation.plan import Criterion, Trial
from services.experiments.evaluation.search import Search, search
from services.experiments.evaluation.worker_cache import Workplace, replace_file
from services.kit.jpeg import encode_jpeg
from services.robot.clock import TICK_S
from smal.movement import placed, seen_from

#: Frames from one kept picture of an example route to the next, and of one kept position of any way.
PICTURE_TICKS, WAY_TICKS = 10, 5


class Drivers:
    """Controllers, made once in each worker."""

    def __init__(self, workplace: Workplace) -> None:
        self._workplace = workplace
        self._made = lru_cache(maxsize=2)(self._make)

    def of_search(self, world: str, trial: Trial) -> Controller:
        """Return who drives in a search."""
        return self._made(world, trial.controller, trial.drives, trial.length)

    def _make(self, world: str, name: str, drives: int, length: int) -> Controller:
        if name == "smal":
            return FilterController(self._workplace.mapped(world, drives))
        if name == "paper":
            return PaperController(self._workplace.model(world, drives, length))
        taught = self._workplace.drives(world, drives)
        if name == "seqslam":
            return SeqSlamController(taught)
        if name == "teach-and-repeat":
            return TeachAndRepeatController(taught, self._workplace.field_of_view_rad)
        return ImitationController(taught, self._workplace.features, int(name.removeprefix("nearest-")))


def run_search(
    workplace: Workplace,
    drivers: Drivers,
    world: str,
    trial: Trial,
    seed: int,
    criterion: Criterion,
    patience: float,
) -> dict[str, Any]:
    """Search once; of SMAL's after one drive and from the start, pictures are kept.

    A belief is right that is as near to the truth as the criterion says; a search times out after `patience` times the
    frames of the longest drive.
    """
    how = degradation_named(trial.degradation)
    simulation = workplace.simulation(world, how.shake, trial.variation)
    kept = (trial.controller, trial.drives, trial.condition) == ("smal", 1, "as taught")
    found = search(
        simulation,
        drivers.of_search(world, trial),
        seed,
        degradation=how,
        start=trial.start,
        kidnap_tick=trial.kidnap_tick,
        max_ticks=round(patience * max(len(one.poses) for one in workplace.drives(world, trial.drives))),
        keep=(lambda tick: tick % PICTURE_TICKS == 0) if kept else lambda _tick: False,
    )
    finding = _finding(found, workplace.poses(world, trial.drives), criterion)
    if kept:
        name = route_file(world, seed)
        replace_file(workplace.folder / name, _route(found).items())
        finding["files"] = [name]
    return finding


def route_file(world: str, seed: int) -> str:
    """Name the file of an example route."""
    return f"route-{Path(world).stem}-{seed}.npz"


def read_route(path: Path) -> dict[str, NDArray[Any]]:
    """Read the file of an example route: poses (ticks + 1, 3), ``ticks`` of the pictures, each ``picture_TICK``."""
    with np.load(path, allow_pickle=False) as held:
        return {name: held[name] for name in held.files}


def _finding(found: Search, taught: NDArray[np.float64], criterion: Criterion) -> dict[str, Any]:
    """Return what a search says, in numbers that JSON knows; `taught` are the true poses of all taught frames."""
    positions = found.poses[:, :2]
    aside_m = np.asarray(KDTree(taught[:, :2]).query(positions)[0], dtype=np.float64)
    said = {
        "outcome": found.outcome,
        "ticks": found.ticks,
        "decisions": len(found.decisions),
        "unknown": found.unknown,
        "shortest_m": round(found.shortest_m, 2),
        "driven_m": round(found.driven_m, 2),
        "aside_rms_m": round(float(np.sqrt(np.mean(aside_m**2))), 4),
        "aside_max_m": round(float(aside_m.max()), 4),
        "aside_m": aside_m[::WAY_TICKS].round(3).tolist(),
        "way": np.concatenate([positions[:-1:WAY_TICKS], positions[-1:]]).round(2).tolist(),
    }
    if any(place is not None for place in found.places):
        right = np.array([_is_right(*pair, taught, criterion) for pair in zip(found.places, found.poses, strict=False)])
        sure = ~np.isin(np.arange(right.size), list(found.unrecognized))
        said["wrong_share"] = round(float((sure & ~right).mean()), 4)
        if 0 < found.kidnap_tick <= found.ticks:
            said["right_after_s"] = _right_after_s((sure & right)[found.kidnap_tick :])
    return said


def _is_right(
    place: Place | None, true: NDArray[np.float64], taught: NDArray[np.float64], criterion: Criterion
) -> bool:
    if place is None:
        return False
    believed = placed(np.array([place.ahead_m, place.left_m, place.turned_rad]), taught[place.frame])
    x, y, turned = seen_from(believed, true)
    return bool(np.hypot(x, y) <= criterion.distance_m and abs(turned) <= math.radians(criterion.angle_deg))


def _right_after_s(right: NDArray[np.bool_]) -> float | None:
    """Return the time after which the belief is right for a whole second, or to the end; None where it never is."""
    second = round(1.0 / TICK_S)
    for tick in range(right.size):
        if right[tick : tick + second].all():
            return round(tick * TICK_S, 1)
    return None


def _route(found: Search) -> dict[str, NDArray[Any]]:
    """Return poses (ticks + 1, 3), the ticks of the pictures, and the pictures as JPEG."""
    pictures = {
        f"picture_{tick}": np.frombuffer(encode_jpeg(image), dtype=np.uint8) for tick, image in found.pictures.items()
    }
    return {"poses": found.poses, "ticks": np.array(sorted(found.pictures))} | pictures
