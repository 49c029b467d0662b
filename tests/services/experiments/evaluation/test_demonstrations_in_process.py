"""Demonstrations made in this process are those that `smal demonstrate` records and `smal learn` reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from schemas.base import ATOMS, Message
from schemas.command import CommandApplied
from schemas.episode import Episode, Purpose
from schemas.image import Image
from schemas.odometry import Odometry
from schemas.pose import Pose
from schemas.rpc import ResetRequest
from services.experiments.evaluation.demonstrations import Drive, demonstrate, drive, load_drives, save_drives
from services.expert.driver import DRIVE_TICKS, RECOVERY_TICKS
from services.expert.service import ExpertService
from services.features.service import FeaturesService
from services.recordings.dataset import unusable
from services.recordings.recorded import RecordedEpisode
from services.simulator.simulation import Simulation
from services.simulator.world import load_world
from smal.action_space import Atom
from smal.features import FeatureSettings
from tests.services.robot.driving import simulated
from tests.services.simulator.simulator_driving import StubCamera

YARD = load_world("yard")
FEATURES = FeatureSettings()


def recorded(simulation: Simulation, seed: int, purpose: Purpose) -> RecordedEpisode:
    """Have the services' objects make one demonstration, and keep what the recorder would."""
    runner, features, expert = (
        simulated(simulation),
        FeaturesService(FEATURES),
        ExpertService(),
    )
    ticks = RECOVERY_TICKS if purpose == "recovery" else DRIVE_TICKS
    reply, waiting = runner.reset(ResetRequest(seed=seed, purpose=purpose, driver="expert", max_ticks=ticks))
    expert.begin(reply)
    kept = RecordedEpisode("rescuebot", reply.episode, purpose=purpose)
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
@pytest.mark.parametrize("purpose", ["drive", "recovery"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_drive_teaches_what_its_recording_teaches(seed: int, purpose: Purpose, victim: float) -> None:
    simulation = Simulation(YARD, StubCamera(victim))
    episode = recorded(simulation, seed, purpose)
    made = drive(simulation, FEATURES, seed, purpose, thumbnails=True)
    if unusable(episode, include_runs=False) is not None:
        assert made is None
        return
    assert made is not None
    (piece,) = episode.pieces()
    np.testing.assert_array_equal(made.demonstration.features, piece.features)
    np.testing.assert_array_equal(made.demonstration.atoms, [Atom[ATOMS[index].upper()] for index in piece.atoms])
    assert made.demonstration.successful == piece.at_goal
    assert made.demonstration.recovery == (purpose == "recovery")
    truth = [episode.poses[tick] for tick in piece.ticks.tolist()]
    np.testing.assert_array_equal(made.demonstration.odometry, piece.odometry)
    assert (made.demonstration.images is not None) == piece.at_goal
    np.testing.assert_array_equal(made.poses, [(pose.x_m, pose.y_m, pose.heading_rad) for pose in truth])
    assert made.thumbnails is not None
    assert len(made.thumbnails) == len(made.poses)


def test_a_whole_drive_that_does_not_see_the_victim_teaches_nothing_and_a_recovery_does() -> None:
    blind = Simulation(YARD, StubCamera(0.0))
    made = demonstrate(blind, FEATURES, 2, 3)
    assert len(made) == 3
    assert all(one.demonstration.recovery and not one.demonstration.successful for one in made)
    seeing = demonstrate(Simulation(YARD, StubCamera(1.0)), FEATURES, 2, 1)
    assert [one.demonstration.name for one in seeing] == ["drive-1", "drive-2", "recovery-1"]
    assert [one.demonstration.atoms[-1] == Atom.STOP for one in seeing[:2]] == [True, True]


def pixels(one: Drive) -> np.ndarray:
    """Return its images, of which a drive has some if it reached the goal."""
    images = one.demonstration.images
    assert (images is not None) == one.demonstration.successful
    return np.stack(list(images)) if images is not None else np.zeros(0)


@pytest.mark.parametrize("thumbnails", [True, False])
def test_drives_survive_a_file(tmp_path: Path, thumbnails: bool) -> None:
    made = demonstrate(Simulation(YARD, StubCamera(1.0)), FEATURES, 1, 2, thumbnails=thumbnails)
    save_drives(tmp_path / "drives.npz", made, FEATURES)
    for before, after in zip(made, load_drives(tmp_path / "drives.npz", FEATURES), strict=True):
        np.testing.assert_array_equal(before.demonstration.features, after.demonstration.features)
        np.testing.assert_array_equal(before.demonstration.atoms, after.demonstration.atoms)
        np.testing.assert_array_equal(before.demonstration.odometry, after.demonstration.odometry)
        np.testing.assert_array_equal(pixels(before), pixels(after))
        np.testing.assert_array_equal(before.poses, after.poses)
        assert (after.thumbnails is not None) == thumbnails
        names = ("name", "successful", "recovery")
        assert [getattr(before.demonstration, n) for n in names] == [getattr(after.demonstration, n) for n in names]
    assert [path.name for path in tmp_path.iterdir()] == ["drives.npz"]


def test_a_file_that_holds_no_such_drives_is_refused_in_one_line_that_names_it(tmp_path: Path) -> None:
    path = tmp_path / "drives.npz"
    save_drives(path, demonstrate(Simulation(YARD, StubCamera(1.0)), FEATURES, 0, 1), FEATURES)
    with pytest.raises(ValueError, match=r"drives\.npz: .*other features"):
        load_drives(path, FeatureSettings.parse("hog"))
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(ValueError, match=r"drives\.npz: no drives can be read") as refused:
        load_drives(path, FEATURES)
    assert "\n" not in str(refused.value)
    with pytest.raises(ValueError, match=r"none\.npz"):
        load_drives(tmp_path / "none.npz", FEATURES)
