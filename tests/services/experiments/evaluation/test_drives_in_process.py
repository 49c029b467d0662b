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
from services.experiments.evaluation.drives import drive, load_drive, save_drive
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


@pytest.mark.parametrize(("seed", "victim"), [(1, 0.0), (2, 1.0)])
def test_a_drive_teaches_what_its_recording_teaches(seed: int, victim: float, tmp_path: Path) -> None:
    simulation = Simulation(YARD, StubCamera(victim))
    episode = recorded(simulation, seed)
    if unusable(episode, include_runs=False) is not None:
        with pytest.raises(ValueError, match="did not reach the victim"):
            drive(simulation, FEATURES, seed)
        return
    save_drive(tmp_path / "drive", drive(simulation, FEATURES, seed))
    made = load_drive(tmp_path / "drive")
    (piece,) = episode.pieces()
    np.testing.assert_array_equal(made.demonstration.features, piece.features)
    np.testing.assert_array_equal(made.demonstration.atoms, [Atom[ATOMS[index].upper()] for index in piece.atoms])
    assert piece.at_goal
    assert len(made.demonstration.images or ()) == len(made.poses)
    truth = [episode.poses[tick] for tick in piece.ticks.tolist()]
    np.testing.assert_array_equal(made.demonstration.odometry, piece.odometry)
    np.testing.assert_array_equal(made.poses, [(pose.x_m, pose.y_m, pose.heading_rad) for pose in truth])
    (tmp_path / "drive").write_bytes((tmp_path / "drive").read_bytes()[:1000])
    with pytest.raises(ValueError, match=r"drive: cannot be read: [^\n]*$"):
        load_drive(tmp_path / "drive")
