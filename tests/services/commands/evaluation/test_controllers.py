"""Every controller, shown a demonstration again, does what was done in it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from services.commands.evaluation.controllers import Controller, ImitationController, SeqSlamController, SmalController
from services.commands.evaluation.demonstrations import Drive
from services.commands.evaluation.plan import SCHEMES, Scheme
from smal.action_space import Atom
from smal.features import FeatureSettings, extract
from smal.learning import Demonstration, LearningSettings, learn
from smal.model import Model
from smal.place_recognition.seqslam import SeqSlamSettings
from tests.services.chain import picture
from tests.services.commands.evaluation.evaluated import Every

FEATURES = FeatureSettings()
LENGTH, FRAMES = 4, 32


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
        drives.append(Drive(Demonstration(name, features, atoms), np.zeros((FRAMES, 3)), images))
    return drives


@pytest.fixture(scope="module")
def model() -> Model:
    settings = LearningSettings(sequence_length=LENGTH)
    return learn([one.demonstration for one in taught()], settings)[0]


def shown(controller: Controller, one: Drive) -> list[Atom]:
    """Return what a controller does in an episode in which it sees a drive again."""
    assert one.thumbnails is not None
    controller.reset()
    moves = []
    for tick, image in enumerate(one.thumbnails):
        features = None if controller.features is None else extract(image, controller.features)
        moves.append(controller.act(tick, image, features).atom)
    return moves


def make(name: str, model: Model) -> Controller:
    drives = taught()
    if name in SCHEMES:
        return SmalController(model, SCHEMES[name])
    if name == "seqslam":
        return SeqSlamController(model, drives, settings=SeqSlamSettings(length=LENGTH))
    return ImitationController(drives, FEATURES, int(name))


@pytest.mark.parametrize(
    ("name", "waits", "sure"), [("smal", 3, 3), ("paper", 3, 3), ("seqslam", 0, 3), ("1", 0, 0), ("5", 0, 0)]
)
def test_a_demonstration_seen_again_is_driven_again(name: str, waits: int, sure: int, model: Model) -> None:
    """SMAL waits for a whole window; SeqSLAM moves at once, though it is not sure yet."""
    controller = make(name, model)
    for one in taught():
        done = shown(controller, one)
        assert done[:waits] == [Atom.STOP] * waits
        assert Atom.STOP not in done[waits : waits + 3]
        assert done[sure:] == [Atom(int(atom)) for atom in one.demonstration.atoms[sure:]]


@pytest.mark.parametrize(
    ("scheme", "stride"), [(SCHEMES["smal"], 1), (Every("smal", "", frames=3), 3), (SCHEMES["paper"], LENGTH)]
)
def test_decisions_come_with_the_first_whole_window_and_then_at_the_stride(
    scheme: Scheme, stride: int, model: Model
) -> None:
    controller = SmalController(model, scheme)
    one = taught()[0]
    moves = [controller.act(tick, np.zeros(0, np.uint8), view) for tick, view in enumerate(one.demonstration.features)]
    assert [tick for tick, move in enumerate(moves) if move.decision] == list(range(LENGTH - 1, FRAMES, stride))
    controller.reset()
    strange = [extract(picture(1000 + tick), FEATURES) for tick in range(LENGTH)]
    moves = [controller.act(tick, np.zeros(0, np.uint8), view) for tick, view in enumerate(strange)]
    assert (moves[-1].atom, moves[-1].decision, moves[-1].recognised) == (Atom.LEFT, "look_around", False)


def test_seqslam_wants_the_drives_that_its_model_was_learned_from(model: Model) -> None:
    drives = taught()
    with pytest.raises(ValueError, match="demonstration elsewhere has no thumbnails"):
        SeqSlamController(model, [drives[0], replace(drives[1], thumbnails=None)])
    assert drives[1].thumbnails is not None
    with pytest.raises(ValueError, match="drive elsewhere has 31 frames, and the model's has 32"):
        SeqSlamController(model, [drives[0], replace(drives[1], thumbnails=drives[1].thumbnails[1:])])
