"""Every controller, shown a demonstration again, does what was done in it."""

from __future__ import annotations

import numpy as np
import pytest

from services.experiments.evaluation.controllers import (
    Controller,
    ImitationController,
    PaperController,
    Seen,
    SeqSlamController,
    seen_by,
)
from services.experiments.evaluation.demonstrations import Drive
from smal.demonstration import Demonstration
from smal.features import FeatureSettings, extract
from smal.movement import Atom
from smal.paper.learning import LearningSettings, learn
from smal.paper.model import Model
from smal.place_recognition.seqslam import SeqSlamSettings
from tests.services.chain import picture

FEATURES = FeatureSettings()
LENGTH, FRAMES = 4, 32
STILL = (0.0, 0.0, 0.0)


def taught() -> list[Drive]:
    """Return a drive along places 0, 1, 2, ... with a turn in the middle, and one elsewhere that turns back."""
    keys = {"there": (0, Atom.LEFT), "elsewhere": (100, Atom.RIGHT)}
    drives = []
    for name, (place, turn) in keys.items():
        images = np.stack([picture(place + k) for k in range(FRAMES)])
        atoms = np.full(FRAMES, Atom.FORWARD, dtype=np.int8)
        atoms[12:16] = turn
        atoms[-1] = Atom.STOP
        features = np.stack([extract(image, FEATURES) for image in images])
        drives.append(Drive(Demonstration(name, features, atoms, images=list(images)), np.zeros((FRAMES, 3))))
    return drives


@pytest.fixture(scope="module")
def model() -> Model:
    settings = LearningSettings(sequence_length=LENGTH)
    return learn([one.demonstration for one in taught()], settings)[0]


def shown(controller: Controller, one: Drive) -> list[Atom]:
    """Return what a controller does in an episode in which it sees a drive again."""
    controller.reset()
    images = enumerate(one.demonstration.images or ())
    return [controller.act(seen_by(controller, tick, image, STILL)).atom for tick, image in images]


def make(name: str, model: Model) -> Controller:
    drives = taught()
    if name == "paper":
        return PaperController(model)
    if name == "seqslam":
        return SeqSlamController(drives, SeqSlamSettings(length=LENGTH))
    return ImitationController(drives, FEATURES, int(name))


@pytest.mark.parametrize(("name", "waits", "sure"), [("paper", 3, 3), ("seqslam", 0, 3), ("1", 0, 0), ("5", 0, 0)])
def test_a_demonstration_seen_again_is_driven_again(name: str, waits: int, sure: int, model: Model) -> None:
    """The paper's scheme waits for a whole window; SeqSLAM moves at once, though it is not sure yet."""
    controller = make(name, model)
    for one in taught():
        done = shown(controller, one)
        # The last sequence is the goal, where the paper's scheme stops.
        end = FRAMES - 1
        assert done[:waits] == [Atom.STOP] * waits
        assert Atom.STOP not in done[waits : waits + 3]
        assert done[sure:end] == [Atom(int(atom)) for atom in one.demonstration.atoms[sure:end]]


def test_decisions_of_the_paper_come_with_every_whole_window(model: Model) -> None:
    controller = PaperController(model)
    one = taught()[0]
    views = [*one.demonstration.features, *[model.mean] * LENGTH]
    moves = [controller.act(Seen(tick, np.zeros(0, np.uint8), view, STILL)) for tick, view in enumerate(views)]
    assert [tick for tick, move in enumerate(moves) if move.decision] == list(range(LENGTH - 1, len(views), LENGTH))
    assert (moves[-1].atom, moves[-1].decision, moves[-1].recognized) == (Atom.STOP, "stop", False)
    assert {move.recognized for move in moves[:-1]} == {True}
