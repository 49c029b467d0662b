"""Demonstrations made in this process are those that `smal demonstrate` records and `smal learn` reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from schemas.base import ATOMS, Message
from schemas.command import CommandApplied
from schemas.episode import Episode
from schemas.image import Image
from schemas.odometry import Odometry
from schemas.pose import Pose
from schemas.rpc import ResetRequest
from services.experiments.evaluation.demonstrations import drive, load_drive, save_drive
from services.expert.driver import DRIVE_TICKS
from services.expert.service import ExpertService
from services.features.service import FeaturesService
from services.recordings.dataset import unusable
from services.recordings.recorded import RecordedEpisode
from services.simulator.simulation import Simulation
from services.simulator.world import load_world
from smal.features import FeatureSettings
from smal.movement import Atom
from tests.services.robot.driving import simulated
from tests.services.simulator.simulator_driving import StubCamera

YARD = load_world("yard")
FEATURES = FeatureSettings()


def recorded(simulation: Simulation, seed: int) -> RecordedEpisode:
    """Have the services' objects make one demonstration, and keep what the recorder would."""
    runner, features, expert = simulated(simulation), FeaturesService(FEATURES), ExpertService()
    reply, waiting = runner.reset(ResetRequest(seed=seed, purpose="drive", driver="expert", max_ticks=DRIVE_TICKS))
    expert.begin(reply)
    kept = RecordedEpisode("rescuebot", reply.episode, purpose="drive")
    while waiting:
        message: Message = waiting.pop(0)
        command = None
        if isinstance(message, Pose):
            command = expert.see(message)
            kept.poses[message.tick] = message
        elif isinstance(message, Image):
            observation = features.handle(message)
            assert observation is not None
            kept.features[message.tick] = observation.features.to_numpy()
            command = expert.handle(observation)
        elif isinstance(message, CommandApplied):
            kept.applied[message.tick] = message
        elif isinstance(message, Odometry):
            kept.odometry[message.tick] = (message.x_m, message.y_m, message.heading_rad)
        elif isinstance(message, Episode) and message.event == "ended":
            kept.outcome, kept.end_tick = message.outcome, message.tick
        if command is not None:
            runner.offer(command)
            waiting.extend(runner.poll())
        if expert.arrived and not waiting and runner.running is not None:
            waiting.extend(runner.end())
    return kept


@pytest.mark.parametrize("victim", [0.0, 1.0])
@pytest.mark.parametrize("seed", [1, 2])
def test_a_drive_teaches_what_its_recording_teaches(seed: int, victim: float) -> None:
    simulation = Simulation(YARD, StubCamera(victim))
    episode = recorded(simulation, seed)
    made = drive(simulation, FEATURES, seed)
    if unusable(episode, include_runs=False) is not None:
        assert made is None
        return
    assert made is not None
    (piece,) = episode.pieces()
    np.testing.assert_array_equal(made.demonstration.features, piece.features)
    np.testing.assert_array_equal(made.demonstration.atoms, [Atom[ATOMS[index].upper()] for index in piece.atoms])
    assert piece.at_goal
    assert len(made.demonstration.images or ()) == len(made.poses)
    truth = [episode.poses[tick] for tick in piece.ticks.tolist()]
    np.testing.assert_array_equal(made.demonstration.odometry, piece.odometry)
    np.testing.assert_array_equal(made.poses, [(pose.x_m, pose.y_m, pose.heading_rad) for pose in truth])


def test_a_drive_survives_a_file_and_a_file_that_holds_none_is_refused_in_one_line(tmp_path: Path) -> None:
    path, before = tmp_path / "drive.npz", drive(Simulation(YARD, StubCamera(1.0)), FEATURES, 1)
    assert before is not None
    save_drive(path, before, FEATURES)
    after = load_drive(path, FEATURES)
    for name in ("name", "focal", "features", "atoms", "odometry", "images"):
        one, other = (getattr(each.demonstration, name) for each in (before, after))
        np.testing.assert_array_equal(
            list(one) if name == "images" else one, list(other) if name == "images" else other
        )
    np.testing.assert_array_equal(before.poses, after.poses)
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(ValueError, match=r"drive\.npz: .*other features"):
        load_drive(path, FeatureSettings.parse("hog"))
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(ValueError, match=r"drive\.npz: no drive can be read") as refused:
        load_drive(path, FEATURES)
    assert "\n" not in str(refused.value)
    with pytest.raises(ValueError, match=r"none\.npz"):
        load_drive(tmp_path / "none.npz", FEATURES)
