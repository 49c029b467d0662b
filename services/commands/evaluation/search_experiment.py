"""Searches of SMAL and of its peers, as numbers that JSON knows, and with pictures for the example route."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.commands.evaluation.controllers import (
    CloningController,
    Controller,
    FilterController,
    ImitationController,
    PaperController,
    SeqSlamController,
)
from services.commands.evaluation.degradation import degradation_named
from services.commands.evaluation.search import Search, search
from services.commands.evaluation.workplace import Workplace, replace_file
from services.jpeg import encode_jpeg
from smal.evaluation.baselines.behaviour_cloning import ClonedBehaviour, CloningSettings, clone

#: Frames from one kept picture of an example route to the next, and of one kept position of any way.
PICTURE_TICKS, WAY_TICKS = 10, 5
#: Networks of behaviour cloning, from other first weights: how well it searches depends on them.
CLONES = 3


class Drivers:
    """Controllers, made once in each worker."""

    def __init__(self, workplace: Workplace) -> None:
        self._workplace = workplace
        self.driver = lru_cache(maxsize=2)(self._driver)
        self._cloned = lru_cache(maxsize=CLONES)(self._clone)

    def of_search(self, world: str, teaching: str, name: str, length: int, seed: int) -> Controller:
        """Return who drives in a search; of cloning's networks another for every seed, in turn."""
        if name == "cloning":
            return CloningController(self._cloned(world, teaching, seed % CLONES))
        return self.driver(world, teaching, name, length)

    def _driver(self, world: str, teaching: str, name: str, length: int) -> Controller:
        if name.startswith("nearest-"):
            return ImitationController(
                self._workplace.drives(world, teaching), self._workplace.features, int(name.removeprefix("nearest-"))
            )
        if name == "seqslam":
            return SeqSlamController(self._workplace.drives(world, teaching))
        model = self._workplace.model(world, teaching, length)
        return FilterController(model) if name == "smal" else PaperController(model)

    def _clone(self, world: str, teaching: str, seed: int) -> ClonedBehaviour:
        drives = self._workplace.drives(world, teaching)
        images = [one.thumbnails for one in drives if one.thumbnails is not None]
        return clone(images, [one.demonstration.atoms for one in drives], CloningSettings(seed=seed))[0]


def run_search(
    workplace: Workplace,
    drivers: Drivers,
    *,
    world: str,
    teaching: str,
    controller: str,
    length: int,
    degradation: str,
    seed: int,
    max_ticks: int,
) -> dict[str, Any]:
    """Search once; of SMAL's with a clear view pictures are kept."""
    how = degradation_named(degradation)
    simulation = workplace.simulation(world, how.shake)
    kept = (controller, degradation) == ("smal", "clean")
    found = search(
        simulation,
        drivers.of_search(world, teaching, controller, length, seed),
        seed,
        degradation=how,
        max_ticks=max_ticks,
        keep=(lambda tick: tick % PICTURE_TICKS == 0) if kept else lambda _tick: False,
    )
    finding = _finding(found)
    if kept:
        name = route_file(world, seed)
        replace_file(workplace.folder / name, _route(found).items())
        finding["files"] = [name]
    return finding


def route_file(world: str, seed: int) -> str:
    """Name the file of an example route."""
    return f"route-{world}-{seed}.npz"


def read_route(path: Path) -> dict[str, NDArray[Any]]:
    """Read the file of an example route: poses (ticks + 1, 3), ``ticks`` of the pictures, each ``picture_TICK``."""
    with np.load(path, allow_pickle=False) as held:
        return {name: held[name] for name in held.files}


def _finding(found: Search) -> dict[str, Any]:
    way = np.concatenate([found.poses[:-1:WAY_TICKS, :2], found.poses[-1:, :2]])
    return {
        "outcome": found.outcome,
        "ticks": found.ticks,
        "decisions": len(found.decisions),
        "unknown": found.unknown,
        "way": way.round(2).tolist(),
    }


def _route(found: Search) -> dict[str, NDArray[Any]]:
    """Return poses (ticks + 1, 3), the ticks of the pictures, and the pictures as JPEG."""
    pictures = {
        f"picture_{tick}": np.frombuffer(encode_jpeg(image), dtype=np.uint8) for tick, image in found.pictures.items()
    }
    return {"poses": found.poses, "ticks": np.array(sorted(found.pictures))} | pictures
