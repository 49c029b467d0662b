"""A search in this process is the search that the services run: outcome, frames, poses, decisions."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from schemas.action import Action
from schemas.base import Message
from schemas.command import Command
from schemas.episode import Episode, Purpose
from schemas.image import Image
from schemas.observation import Observation
from schemas.odometry import Odometry
from schemas.pose import Pose as TruePose
from schemas.rpc import ResetRequest, Scheme
from services.experiments.evaluation.controllers import (
    Controller,
    FilterController,
    Move,
    PaperController,
    Seen,
    seen_by,
)
from services.experiments.evaluation.degradation import Degradation
from services.experiments.evaluation.search import search
from services.expert.driver import RouteDriver
from services.features.service import FeaturesService
from services.kit.model_service import LoadedModel
from services.policy.service import PolicyService
from services.recognition.service import RecognitionService
from services.simulator.opening import open_simulation
from services.simulator.sensors.camera import CameraSettings
from services.simulator.simulation import Simulation
from services.simulator.world import load_world
from smal.action_space import Atom
from smal.features import FeatureSettings
from smal.model import Model
from tests.services.robot.driving import simulated
from tests.services.simulator.simulator_driving import StubCamera

YARD = load_world("yard")
FEATURES = FeatureSettings()


class Script:
    """Does what it was told, tick by tick, and then goes on with the last of it."""

    features = None

    def __init__(self, atoms: list[Atom]) -> None:
        self._atoms = atoms

    def reset(self) -> None:
        pass

    def act(self, seen: Seen) -> Move:
        return Move(self._atoms[min(seen.tick, len(self._atoms) - 1)])


def by_services(
    simulation: Simulation,
    answer: Callable[[Image | Odometry], Iterator[Message]],
    seed: int,
    max_ticks: int,
    purpose: Purpose = "run",
) -> tuple[Episode, NDArray[np.float64], list[Message]]:
    """Run an episode with the simulator's own messages; return its end, its poses, and what was answered."""
    runner = simulated(simulation)
    _, waiting = runner.reset(ResetRequest(seed=seed, purpose=purpose, driver="policy", max_ticks=max_ticks))
    poses, answers, end = [], [], None
    while waiting:
        message = waiting.pop(0)
        if isinstance(message, TruePose):
            poses.append((message.x_m, message.y_m, message.heading_rad))
        if isinstance(message, Episode) and message.event == "ended":
            end = message
        if isinstance(message, Image | Odometry):
            for said in answer(message):
                answers.append(said)
                if isinstance(said, Command):
                    runner.offer(said)
                    waiting.extend(runner.poll())
    assert end is not None
    return end, np.array(poses), answers


def obeying(controller: Controller) -> Callable[[Image | Odometry], Iterator[Message]]:
    def answer(image: Image | Odometry) -> Iterator[Message]:
        if isinstance(image, Odometry):
            return
        move = controller.act(seen_by(controller, image.tick, image.to_numpy(), (0.0, 0.0, 0.0)))
        yield Command.after(image, source="policy", atom=move.atom.name.lower())

    return answer


@pytest.mark.parametrize(
    ("atoms", "victim", "outcome"),
    [
        ([Atom.FORWARD], 0.0, "collision"),
        ([Atom.LEFT], 0.0, "timeout"),
        ([Atom.BACKWARD, Atom.STOP], 0.0, "timeout"),
    ],
)
@pytest.mark.parametrize("seed", [1, 2])
def test_rules_of_the_episode_are_those_of_the_simulator(
    atoms: list[Atom], victim: float, outcome: str, seed: int
) -> None:
    simulation = Simulation(YARD, StubCamera(victim))
    found = search(simulation, Script(atoms), seed, max_ticks=200)
    end, poses, _ = by_services(simulation, obeying(Script(atoms)), seed, 200)
    assert (found.outcome, found.ticks) == (end.outcome, end.tick)
    assert found.outcome == outcome
    np.testing.assert_array_equal(found.poses, poses)
    assert found.poses.shape == (found.ticks + 1, 3)


def test_a_search_ends_where_the_victim_comes_near_and_in_view() -> None:
    """The way of a demonstration, which begins elsewhere, does not lead there; that of its own start does."""
    simulation = Simulation(YARD, StubCamera(1.0))
    script = Script(way_of_a_run(simulation, seed=4))
    found = search(simulation, script, 4)
    end, poses, _ = by_services(simulation, obeying(script), 4, 3000)
    assert (found.outcome, found.ticks) == (end.outcome, end.tick) == ("found", len(poses) - 1)
    away_m = np.hypot(found.poses[:, 0] - YARD.victim.x, found.poses[:, 1] - YARD.victim.y)
    assert np.flatnonzero(away_m <= simulation.found_m)[0] == found.ticks
    blind = search(Simulation(YARD, StubCamera(0.0)), script, 4, max_ticks=found.ticks + 20)
    assert blind.outcome in {"timeout", "collision"}
    assert blind.ticks > found.ticks


def way_of_a_run(simulation: Simulation, seed: int) -> list[Atom]:
    """Return the keys of the expert on the start of a run."""
    simulation.reset(seed, "run")
    driver = RouteDriver(simulation.route().tolist(), simulation.speed_m_s, simulation.found_m)
    keys: list[Atom] = []
    while not driver.arrived(simulation.pose.x, simulation.pose.y):
        key = driver.key(simulation.pose.x, simulation.pose.y, simulation.pose.heading)
        simulation.advance(key, 1.0, 0.1)
        keys.append(Atom[key.upper()])
        assert len(keys) < 2000
    return keys


def test_pictures_of_chosen_ticks_are_what_the_controller_saw() -> None:
    seen: dict[int, NDArray[np.uint8]] = {}

    class Looking(Script):
        def act(self, frame: Seen) -> Move:
            seen[frame.tick] = frame.image.copy()
            return super().act(frame)

    found = search(
        Simulation(YARD, StubCamera()), Looking([Atom.LEFT]), 1, degradation=Degradation(noise=20.0), max_ticks=10,
        keep=lambda tick: tick % 5 == 0,
    )  # fmt: skip
    assert list(found.pictures) == [0, 5, 10]
    for tick in (0, 5):
        np.testing.assert_array_equal(found.pictures[tick], seen[tick])
    assert found.pictures[0].std() > 10


@pytest.mark.rendering
@pytest.mark.parametrize("scheme", ["filter", "paper"])
def test_smal_in_this_process_and_as_services_drives_alike_to_the_last_bit(taught: Path, scheme: Scheme) -> None:
    """What the processes add is transport: `RecognitionService` and the others hold all that decides."""
    path = taught / "model.smal"
    simulation, model = open_simulation("yard", CameraSettings(160, 120)), Model.load(path)
    features, recognition, policy = FeaturesService(FEATURES), RecognitionService(), PolicyService()
    for service in (recognition, policy):
        service.load(LoadedModel.read(path, scheme))

    def answer(message: Image | Odometry) -> Iterator[Message]:
        if isinstance(message, Image):
            observation = features.handle(message)
            assert isinstance(observation, Observation)
            state = recognition.handle(observation)
        else:
            state = recognition.see(message)
        if state is not None:
            yield from policy.handle(state)

    controller = FilterController(model) if scheme == "filter" else PaperController(model)
    for seed in (1, 2):
        found = search(simulation, controller, seed, max_ticks=150)
        end, poses, answers = by_services(simulation, answer, seed, 150)
        assert (found.outcome, found.ticks) == (end.outcome, end.tick)
        np.testing.assert_array_equal(found.poses, poses)
        # The services answer the frame that ends the episode as well; nobody carries that out.
        carried_out = [one for one in answers if one.tick < found.ticks]
        commands = [Atom[one.atom.upper()] for one in carried_out if isinstance(one, Command)]
        assert commands == found.atoms.tolist()
        actions = {one.tick: one for one in carried_out if isinstance(one, Action)}
        assert {tick: one.kind for tick, one in actions.items()} == found.decisions
        assert found.unrecognized == {tick for tick, one in actions.items() if one.state is None}
        assert len(found.decisions) >= found.ticks // model.sequence_length
