"""What units do: drives that teach, held-out ones, and searches of every driver, in a small world."""

import json
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from schemas.rpc import ResetRequest
from services.experiments.evaluation import drivers as methods
from services.experiments.evaluation import units as work
from services.experiments.evaluation.plan import (
    Criterion,
    EvaluationPlan,
    Trial,
    WorldPlan,
)
from services.experiments.evaluation.results import timed
from services.experiments.evaluation.search import finding, search
from services.experiments.evaluation.units import Finding, Recognize, Searches, Unit, units
from services.simulator.sensors.readings import Tilt
from services.simulator.simulation import Simulation
from services.simulator.world import load_world
from services.simulator.world.place import Pose
from smal.evaluation.driver import PlaceEstimate
from smal.features import FeatureSettings
from smal.movement import STANDS, Atom, Motion
from tests.services.experiments.evaluation.evaluated import DRIVERS
from tests.services.simulator.simulator_driving import StubCamera


def plan(world: Path) -> EvaluationPlan:
    """Return a plan in which every unit does something."""
    special = Trial("smal", 1, 1, kidnap_tick=10), Trial("smal", 1, 1, degradation="occluded")
    trials = (*(Trial(name, 1, 1) for name in DRIVERS), *special)
    small = WorldPlan(
        str(world),
        Criterion(1.0, 25.0),
        queries=1,
        lengths=(5,),
        recognized=("clean",),
        trials=trials,
    )
    return EvaluationPlan("small", (small,), patience=0.2)


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
    return cv2.resize(np.concatenate([coarse, coarse[:, :1]], axis=1), (264, 48))[:, :256].astype(
        float
    )


@pytest.fixture(scope="module")
def found(
    near: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Path, dict[Unit, Finding]]]:
    """Do all units of the plan, one after another."""
    folder = tmp_path_factory.mktemp("units")
    patch = pytest.MonkeyPatch()
    simulation = Simulation(load_world(near), PlaceCamera(1.0))
    usual = FeatureSettings(("color",))
    patch.setattr(work, "simulation_in", lambda *_: simulation)
    for module in (work, methods):
        # The usual ones take ten times as long to make views of.
        patch.setattr(module, "FEATURES", usual)
    yield folder, {unit: timed(folder, unit) for unit in units(plan(near))}
    patch.undo()


@pytest.mark.long
def test_units_return_json_and_write_their_files(
    found: tuple[Path, dict[Unit, Finding]],
) -> None:
    folder, every = found
    for unit, one in every.items():
        assert json.loads(json.dumps(one)) == one
        assert unit.file(folder).exists() == bool(one.get("file"))
        if isinstance(unit, Searches):
            (said,) = one["searches"]
            assert said["outcome"] in {"found", "collision", "timeout", "false_goal"}
            assert 0.0 <= said["aside_rms_m"] <= said["aside_max_m"]
            assert said["wrong_share"] <= said["sure_share"]
            assert (said["sure_share"] == 0.0) == unit.trial.driver.startswith("paper")
            assert len(one["decision_ms"]) in (said["ticks"], said["ticks"] + 1)
            assert said["clearance_p5_m"] > 0.0 or said["outcome"] == "collision"
            assert one["file"] == (unit.is_example and said["outcome"] == "found")
            if unit.trial.kidnap_tick:
                # Being carried away is no driving, and its recovery is timed.
                assert said["driven_m"] < 0.2 * said["ticks"] + 0.5  # at most 2 m/s
                assert (
                    said["right_after_s"] is None
                    or 0.0 <= said["right_after_s"] <= said["ticks"] / 10
                )
        if isinstance(unit, Recognize):
            (said,) = one["queries"]
            assert len(said["score"]) == len(said["right"]) == len(said["findable"]) > 5
            # A held-out drive of the same way: in a clear view nearly all is recognized.
            assert np.mean(said["right"]) > 0.5


class Says:
    """Stands still, and says where it is: nowhere for two frames, then wrong for two, then right."""

    said = None

    def __init__(self, right: Pose) -> None:
        self._right = PlaceEstimate(0, turned_rad=right.heading)

    def reset(self, _seed: int) -> None:
        self._tick = -1

    def step(self, *_given: object) -> Motion:
        self._tick += 1
        return STANDS

    @property
    def place(self) -> PlaceEstimate | None:
        if self._tick < 2:
            return None
        return self._right._replace(ahead=50.0) if self._tick < 4 else self._right


def test_a_belief_is_held_against_the_truth() -> None:
    simulation = Simulation(load_world("yard"), PlaceCamera(1.0))
    start = simulation.reset(5, "run")
    made = search(simulation, Says(start), ResetRequest(seed=5, purpose="run", max_ticks=20))
    taught = np.array([[start.x, start.y, 0.0]])
    said = finding(made, taught, Criterion(1.0, 25.0))
    assert said["wrong_share"] == pytest.approx(2 / 20)
    assert (said["driven_m"], said["aside_max_m"]) == pytest.approx((0.0, 0.0), abs=0.01)
    carried = finding(replace(made, kidnap_tick=1), taught, Criterion(1.0, 25.0))
    assert carried["right_after_s"] == pytest.approx(0.3)
    assert said["clearance_p5_m"] == pytest.approx(simulation.clearance_m, abs=1e-4)
    # Half a metre to the cube of the seconds, then carried far away.
    seconds = np.arange(21) / 10
    carried_m = 100.0 * (np.arange(21) >= 10)
    way = np.column_stack([0.5 * seconds**3 + carried_m, carried_m, np.zeros(21)])
    atoms = np.array(
        [Atom.LEFT, Atom.LEFT, Atom.RIGHT, Atom.FORWARD, Atom.RIGHT] * 4, dtype=np.int8
    )
    moved = finding(
        replace(made, poses=way, atoms=atoms, kidnap_tick=10), taught, Criterion(1.0, 25.0)
    )
    assert (moved["jerk_m_s3"], moved["turns"]) == (pytest.approx(3.0), 12)
    assert moved["driven_m"] == pytest.approx(4.0, abs=0.2)
