"""Every driver of an evaluation drives what was taught, and what it found is numbers."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from services.commands.evaluation import search_experiment
from services.commands.evaluation.demonstrations import Drive, demonstrate
from services.commands.evaluation.plan import PEERS, SCHEMES
from services.commands.evaluation.search_experiment import (
    CLONES,
    WAY_TICKS,
    Drivers,
    read_route,
    route_file,
    run_search,
)
from services.commands.evaluation.workplace import Workplace
from services.simulator.sensors import Tilt
from services.simulator.simulation import Simulation
from services.simulator.world import load_world
from services.simulator.world.place import Pose
from smal.action_space import Atom
from smal.evaluation.baselines.behaviour_cloning import CloningSettings
from smal.features import FeatureSettings
from smal.learning import LearningSettings, learn
from smal.model import Model
from tests.services.simulator.simulator_driving import StubCamera

FEATURES = FeatureSettings()


class PlaceCamera(StubCamera):
    """Sees a quarter of a smooth random panorama, which becomes another one within two metres."""

    def render(self, pose: Pose, tilt: Tilt) -> np.ndarray:
        number, share = divmod(100.0 + (pose.x + pose.y) / 2.0, 1.0)
        around = (1.0 - share) * panorama(int(number)) + share * panorama(int(number) + 1)
        start = -int(256 * pose.heading / (2.0 * np.pi)) % 256
        return np.take(around, np.arange(start, start + 64), axis=1, mode="wrap").astype(np.uint8)


@cache
def panorama(number: int) -> np.ndarray:
    coarse = np.random.default_rng(number).integers(0, 255, (6, 32, 3), dtype=np.uint8)
    return cv2.resize(np.concatenate([coarse, coarse[:, :1]], axis=1), (264, 48))[:, :256].astype(float)


class Forward:
    """In place of a network."""

    def act(self, thumbnail: np.ndarray) -> Atom:
        assert thumbnail.shape == (48, 64, 3)
        return Atom.FORWARD


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    return Simulation(load_world("yard"), PlaceCamera(1.0))


@pytest.fixture(scope="module")
def drives(simulation: Simulation) -> tuple[Drive, ...]:
    return tuple(demonstrate(simulation, FEATURES, 1, 1, thumbnails=True))


@pytest.fixture(scope="module")
def model(drives: tuple[Drive, ...]) -> Model:
    return learn([one.demonstration for one in drives], LearningSettings(sequence_length=5))[0]


@pytest.fixture
def place(simulation: Simulation, drives: tuple[Drive, ...], model: Model, tmp_path: Path) -> Workplace:
    made = Workplace(tmp_path, (32, 24))
    made.simulation = lambda world, shake: simulation  # type: ignore[method-assign]
    made.drives = lambda world, teaching: drives  # type: ignore[method-assign]
    made.model = lambda world, teaching, length: model  # type: ignore[method-assign]
    return made


@pytest.mark.parametrize("controller", [*SCHEMES, *PEERS])
def test_whoever_drives_the_finding_is_numbers(
    controller: str, place: Workplace, monkeypatch: pytest.MonkeyPatch
) -> None:
    def clone(images: list[np.ndarray], atoms: list[np.ndarray], settings: CloningSettings) -> tuple[Forward, None]:
        assert settings.seed == 3 % CLONES
        assert [len(each) for each in images] == [len(each) for each in atoms]
        return Forward(), None

    monkeypatch.setattr(search_experiment, "clone", clone)
    drivers = Drivers(place)
    found = run_search(
        place, drivers, world="yard", teaching="t", controller=controller, length=5, degradation="clean", seed=3,
        max_ticks=30,
    )  # fmt: skip
    assert json.loads(json.dumps(found)) == found
    assert found["outcome"] in {"found", "collision", "timeout"}
    assert 1 <= found["ticks"] <= 30
    assert len(found["way"]) == -(-found["ticks"] // WAY_TICKS) + 1
    decides = {"paper": (found["ticks"] - 5) // 5 + 1, "cloning": 0, "nearest-1": 0, "nearest-5": 0}
    if controller in decides:
        assert found["decisions"] == decides[controller]
    assert ("files" in found) == (controller == "smal")


def test_pictures_of_a_search_at_the_defaults_are_kept(place: Workplace) -> None:
    asked = {"world": "yard", "teaching": "t", "controller": "smal", "length": 5, "seed": 1, "max_ticks": 25}
    found = run_search(place, Drivers(place), degradation="clean", **asked)  # type: ignore[arg-type]
    route = read_route(place.folder / route_file("yard", 1))
    assert found["files"] == [route_file("yard", 1)]
    assert route["poses"].shape == (found["ticks"] + 1, 3)
    assert route["ticks"].tolist() == list(range(0, found["ticks"] + 1, 10))
    assert all(f"picture_{tick}" in route for tick in route["ticks"])
    degraded = run_search(place, Drivers(place), degradation="occluded", **asked)  # type: ignore[arg-type]
    assert "files" not in degraded
