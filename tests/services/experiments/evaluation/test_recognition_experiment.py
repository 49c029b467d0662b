"""Every recognizer, asked about what it was taught, answers with the frame itself; held-out drives are as declared."""

from __future__ import annotations

import numpy as np
import pytest

from services.experiments.evaluation.degradation import CLEAN, DEGRADATIONS
from services.experiments.evaluation.demonstrations import drive
from services.experiments.evaluation.recognition_experiment import (
    query_drive,
    recognize_nearest,
    recognize_states,
)
from services.simulator.simulation import Simulation
from services.simulator.world import load_world
from smal.demonstration import Demonstration
from smal.features import FeatureSettings, extract
from smal.paper.learning import LearningSettings, learn
from tests.services.chain import picture
from tests.services.simulator.simulator_driving import StubCamera

FEATURES = FeatureSettings()


def test_a_held_out_drive_is_that_of_the_expert_seen_in_several_ways() -> None:
    simulation = Simulation(load_world("yard"), StubCamera(1.0))
    views = {"clean": CLEAN, "noisy": DEGRADATIONS["noisy"]}
    made = query_drive(simulation, FEATURES, 1000, views)
    taught = drive(simulation, FEATURES, 1000)
    assert taught is not None
    frames = len(taught.poses)
    assert abs(len(made["poses"]) - frames) <= 1
    count = min(frames, len(made["poses"]))
    np.testing.assert_array_equal(made["poses"][:count], taught.poses[:count])
    np.testing.assert_array_equal(made["features_clean"][:count], taught.demonstration.features[:count])
    assert made["features_noisy"].shape == made["features_clean"].shape
    assert (made["seqslam_noisy"] != made["seqslam_clean"]).any()


@pytest.mark.parametrize("novelty", ["agreement", "weight"])
def test_states_that_were_taught_are_where_they_were_taught(novelty: str) -> None:
    views = np.stack([extract(picture(place), FEATURES) for place in range(40)])
    atoms = np.ones(40, dtype=np.int8)
    settings = LearningSettings(sequence_length=4, novelty=novelty)
    model, _ = learn([Demonstration("drive", views, atoms)], settings)
    matches = recognize_states(model, views)
    assert not matches.matched[:3].any()
    assert matches.matched[3:].all()
    assert np.abs(matches.reference[3:] - np.arange(3, 40)).max() <= 1
    assert (matches.score[3:] > 0.1).all()


def test_the_nearest_window_is_of_one_drive_and_counted_over_all() -> None:
    rng = np.random.default_rng(1)
    frames = rng.standard_normal((13, 8)).astype(np.float32)
    frames /= np.linalg.norm(frames, axis=1, keepdims=True)
    drives = [frames[:6], frames[6:8], frames[8:]]
    matches = recognize_nearest(drives, frames, 3)
    # What the second drive shows is too short for a window, and none leads over the seams.
    whole = [2, 3, 4, 5, 10, 11, 12]
    assert matches.reference[whole].tolist() == whole
    assert matches.score[whole] == pytest.approx(1.0)
    assert matches.reference[:2].tolist() == [-1, -1]
    assert set(matches.reference[2:].tolist()) == set(whole)
