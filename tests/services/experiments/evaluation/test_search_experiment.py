"""Every driver of an evaluation drives what was taught, and what it found is numbers."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from services.experiments.evaluation.controllers import Move, Seen
from services.experiments.evaluation.controllers import Place as EvaluatedPlace
from services.experiments.evaluation.demonstrations import Drive, drive
from services.experiments.evaluation.plan import CONTROLLERS, Criterion, Trial
from services.experiments.evaluation.search import search
from services.experiments.evaluation.search_experiment import (
    WAY_TICKS,
    Drivers,
    _finding,
    read_route,
    route_file,
    run_search,
)
from services.experiments.evaluation.worker_cache import Workplace
from services.simulator.sensors import Tilt
from services.simulator.simulation import Simulation
from services.simulator.world import load_world
from services.simulator.world.place import Pose
from smal.features import FeatureSettings
from smal.mapping import learn as learn_map
from smal.model import Model
from smal.movement import Atom
from smal.paper.learning import LearningSettings, learn
from smal.paper.model import Model as PaperModel
from tests.services.simulator.simulator_driving import StubCamera

#: The usual ones take ten times as long to make views of; the findings are of the same form.
FEATURES = FeatureSettings(("color",), (1.0,))


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


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    return Simulation(load_world("yard"), PlaceCamera(1.0))


@pytest.fixture(scope="module")
def drives(simulation: Simulation) -> tuple[Drive, ...]:
    made = drive(simulation, FEATURES, 1)
    assert made is not None
    return (made,)


@pytest.fixture(scope="module")
def model(drives: tuple[Drive, ...]) -> PaperModel:
    return learn([one.demonstration for one in drives], LearningSettings(FEATURES, 5))[0]


@pytest.fixture(scope="module")
def mapped(drives: tuple[Drive, ...]) -> Model:
    return learn_map([one.demonstration for one in drives], FEATURES)


@pytest.fixture
def place(
    simulation: Simulation, drives: tuple[Drive, ...], model: PaperModel, mapped: Model, tmp_path: Path
) -> Workplace:
    made = Workplace(tmp_path, (32, 24))
    made.features = FEATURES
    made.simulation = lambda world, shake, variation: simulation  # type: ignore[method-assign]
    made.drives = lambda world, count: drives  # type: ignore[method-assign]
    made.model = lambda world, count, length: model  # type: ignore[method-assign]
    made.mapped = lambda world, count: mapped  # type: ignore[method-assign]
    return made


#: So that searches time out after 30 frames.
SOON, NEAR = 30, Criterion(1.0, 25.0)


def patience(drives: tuple[Drive, ...]) -> float:
    return SOON / max(len(one.poses) for one in drives)


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_whoever_drives_the_finding_is_numbers(controller: str, place: Workplace, drives: tuple[Drive, ...]) -> None:
    drivers = Drivers(place)
    found = run_search(place, drivers, "yard", Trial(controller, 1, 1), 3, NEAR, patience(drives))
    assert json.loads(json.dumps(found)) == found
    assert found["outcome"] in {"found", "collision", "timeout"}
    assert 1 <= found["ticks"] <= 30
    assert len(found["way"]) == -(-found["ticks"] // WAY_TICKS) + 1
    assert 0.0 <= found["aside_rms_m"] <= found["aside_max_m"]
    assert ("wrong_share" in found) == (controller == "smal")
    decides = {"paper": (found["ticks"] - 5) // 5 + 1, "nearest-1": 0, "nearest-5": 0}
    if controller in decides:
        assert found["decisions"] == decides[controller]
    assert ("files" in found) == (controller == "smal")


def test_pictures_of_a_search_at_the_defaults_are_kept(place: Workplace, drives: tuple[Drive, ...]) -> None:
    found = run_search(place, Drivers(place), "yard", Trial("smal", 1, 1), 1, NEAR, patience(drives))
    route = read_route(place.folder / route_file("yard", 1))
    assert found["files"] == [route_file("yard", 1)]
    assert route["poses"].shape == (found["ticks"] + 1, 3)
    assert route["ticks"].tolist() == list(range(0, found["ticks"] + 1, 10))
    assert all(f"picture_{tick}" in route for tick in route["ticks"])
    for special in (Trial("smal", 1, 1, degradation="occluded"), Trial("smal", 1, 1, start="anywhere")):
        assert "files" not in run_search(place, Drivers(place), "yard", special, 1, NEAR, patience(drives))


def test_being_carried_away_is_no_driving_and_its_recovery_is_timed(
    place: Workplace, drives: tuple[Drive, ...]
) -> None:
    carried = Trial("smal", 1, 1, kidnap_tick=10)
    found = run_search(place, Drivers(place), "yard", carried, 1, NEAR, patience(drives))
    way = np.array(found["way"])
    assert np.hypot(*np.diff(way, axis=0).T).max() > 3.0
    # At 2 m/s it cannot drive further in three seconds.
    assert found["driven_m"] < 0.2 * SOON + 0.5
    assert found["right_after_s"] is None or 0.0 <= found["right_after_s"] <= 2.0


class Says:
    """Stands still, and says where it is: nowhere for two frames, then wrong for two, then right."""

    features = None

    def __init__(self, right: Pose) -> None:
        self._places = [None, None, EvaluatedPlace(0, 50.0, 0.0, 0.0), EvaluatedPlace(0, 50.0, 0.0, 0.0)]
        self._right = EvaluatedPlace(0, 0.0, 0.0, right.heading)

    def reset(self) -> None:
        self._tick = 0

    def act(self, seen: Seen) -> Move:
        place = self._places[seen.tick] if seen.tick < len(self._places) else self._right
        return Move(Atom.STOP, "look_around" if place is None else "follow", place is not None, place=place)


def test_a_belief_is_held_against_the_truth(simulation: Simulation) -> None:
    start = simulation.reset(5, "run")
    taught = np.array([[start.x, start.y, 0.0]])
    found = search(simulation, Says(start), 5, max_ticks=20)
    said = _finding(found, taught, NEAR)
    assert said["wrong_share"] == pytest.approx(2 / 20)
    assert (said["driven_m"], said["aside_max_m"]) == (pytest.approx(0.0, abs=0.01), pytest.approx(0.0, abs=0.01))
    assert _finding(replace(found, kidnap_tick=1), taught, NEAR)["right_after_s"] == pytest.approx(0.3)
