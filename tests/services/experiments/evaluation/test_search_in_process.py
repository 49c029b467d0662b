"""A search in this process is the search that the services run: outcome, frames, poses, decisions."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from schemas.base import Message
from schemas.camera import CompressedImage
from schemas.command import Command
from schemas.episode import Episode, Purpose
from schemas.motion import Odometry, TruePose
from schemas.rpc import ResetRequest, Scheme
from services.experiments.evaluation.search import search
from services.features.service import FeaturesService
from services.kit.model_service import LoadedModel, load_model
from services.policy.service import PolicyService
from services.recognition.service import RecognitionService
from services.simulator.opening import open_simulation
from services.simulator.sensors.camera import CameraSettings
from services.simulator.simulation import Simulation
from smal.evaluation.drivers import PaperDriver, SmalDriver
from smal.features import FeatureSettings
from smal.model import Model
from smal.movement import Atom
from tests.services.robot.driving import simulated

FEATURES = FeatureSettings()
TICKS = 60


def by_services(
    simulation: Simulation,
    answer: Callable[[CompressedImage | Odometry], Iterator[Message]],
    seed: int,
    max_ticks: int,
    purpose: Purpose = "run",
) -> tuple[Episode, NDArray[np.float64], list[Message]]:
    """Run an episode with the simulator's own messages; return its end, its poses, and what was answered."""
    runner = simulated(simulation)
    _, waiting = runner.reset(
        ResetRequest(seed=seed, purpose=purpose, driver="policy", max_ticks=max_ticks)
    )
    poses = []
    answers = []
    end = None
    while waiting:
        message = waiting.pop(0)
        if isinstance(message, TruePose):
            poses.append((message.x_m, message.y_m, message.heading_rad))
        if isinstance(message, Episode) and message.event == "ended":
            end = message
        if isinstance(message, CompressedImage | Odometry):
            for said in answer(message):
                answers.append(said)
                if isinstance(said, Command):
                    runner.offer(said)
                    waiting.extend(runner.poll())
    return end, np.array(poses), answers


@pytest.fixture(scope="module")
def simulation(near: Path) -> Simulation:
    return open_simulation(str(near), CameraSettings(160, 120), depth=True)


@pytest.mark.long
@pytest.mark.rendering
@pytest.mark.parametrize("scheme", ["filter", "paper"])
def test_search_is_bit_identical_in_process_and_in_services(
    simulation: Simulation, taught: Path, taught_paper: Path, scheme: Scheme
) -> None:
    file = taught_paper if scheme == "paper" else taught / "model.smal"
    model = load_model(file)
    features = FeaturesService(FEATURES)
    recognition = RecognitionService()
    policy = PolicyService()
    for service in (recognition, policy):
        service.load(LoadedModel.read(file))

    def answer(message: CompressedImage | Odometry) -> Iterator[Message]:
        if isinstance(message, CompressedImage):
            observation = features.handle(message)
            state = recognition.handle(observation)
        else:
            state = recognition.see(message)
        if state is not None:
            yield from policy.handle(state)

    driver = SmalDriver(model) if isinstance(model, Model) else PaperDriver(model)
    # The services use the seed 0.
    found = search(simulation, driver, ResetRequest(seed=0, purpose="run", max_ticks=TICKS))
    end, poses, answers = by_services(simulation, answer, 0, TICKS)
    assert (found.outcome, len(found.atoms)) == (end.outcome, end.tick)
    np.testing.assert_array_equal(found.poses, poses)
    # The services answer the frame that ends the episode as well; nobody carries that out.
    carried_out = [one for one in answers if isinstance(one, Command) and one.tick < end.tick]
    assert [Atom[one.atom.upper()] for one in carried_out] == found.atoms.tolist()
