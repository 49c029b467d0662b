"""Learning a corridor, then finding the way in it by the paper's scheme."""

import dataclasses

import numpy as np
import pytest

from smal.movement import Atom
from smal.paper.execution import DecisionMaker, PaperDecision, Recognition
from smal.paper.learning import LearningSettings, learn
from smal.paper.model import PaperModel
from smal.paper.recognition import Recognizer
from smal.paper.state_matching import solve
from tests.smal.worlds import COLOR, corridor, drive

PLACES = 120
LENGTH = 5
VIEWS = corridor(PLACES)
DRIVES = [drive(VIEWS, start, seed=start, name=f"drive {start}") for start in range(4)]
RECOVERY = dataclasses.replace(drive(VIEWS, 40, seed=9, name="recovery", end=72), recovery=True)


@pytest.fixture(scope="module")
def model() -> PaperModel:
    return learn([*DRIVES, RECOVERY], LearningSettings(features=COLOR, tau=0.6))


def seen(model: PaperModel, frames: np.ndarray, tick: int = 0) -> list[Recognition]:
    recognizer = Recognizer(model)
    return [recognizer.observe(tick + k, frame, due=True) for k, frame in enumerate(frames)]


@pytest.mark.parametrize("noise", [0.3, 4.0])
def test_state_is_that_of_eq_9_when_views_are_noisy(model: PaperModel, noise: float) -> None:
    query = drive(VIEWS, 3, seed=77, noise=noise).features[:40]
    centred = model.centering.apply(query)
    for tick, found in enumerate(seen(model, query)):
        if tick < LENGTH - 1:
            assert found == Recognition("collecting", tick)
            continue
        Y = np.asfortranarray(centred[tick - LENGTH + 1 : tick + 1].T)
        W = solve(model.templates, Y, LENGTH, model.lambda1, model.lambda2, 1e-5).weights
        heaviest = np.abs(W).reshape(model.states, -1).sum(axis=1)
        assert (found.status == "unknown") == (found.total_weight == 0.0)
        if found.state is None:
            assert heaviest.max() < 0.05, "zero, but for the tolerance"
            continue
        assert heaviest[found.state] > 0.97 * heaviest.max()
        assert found.score == pytest.approx(heaviest.max() / LENGTH, abs=0.03)
        assert found.total_weight == pytest.approx(heaviest.sum() / LENGTH, abs=0.1)
        assert found.duality_gap <= 1e-3


def test_window_starts_anew_when_a_frame_is_dropped(model: PaperModel) -> None:
    recognizer = Recognizer(model)
    query = DRIVES[0].features
    statuses = [
        recognizer.observe(tick, query[tick], due=True).status
        for tick in (*range(6), *range(7, 13))
    ]
    assert (
        statuses
        == ["collecting"] * 4 + ["recognized"] * 2 + ["collecting"] * 4 + ["recognized"] * 2
    )
    recognizer.reset()
    assert recognizer.observe(13, query[13], due=True).status == "collecting"


def test_features_are_refused_when_they_are_invalid(model: PaperModel) -> None:
    recognizer = Recognizer(model)
    query = DRIVES[0].features
    for tick in range(4):
        recognizer.observe(tick, query[tick], due=True)
    for bad in (np.full(COLOR.size, np.nan), np.zeros(3), np.zeros((2, COLOR.size))):
        with pytest.raises(ValueError, match="features"):
            recognizer.observe(4, bad.astype(np.float32), due=True)
    assert recognizer.observe(4, query[4], due=True).status == "recognized"


def test_policy_action_is_executed_whole_and_then_stops(model: PaperModel) -> None:
    maker = DecisionMaker(model)
    for state in np.flatnonzero(model.policy >= 0).tolist():
        decision = maker.decide(Recognition("recognized", 0, state))
        action = int(model.policy[state])
        assert decision == PaperDecision(
            "action", tuple(model.actions[action].tolist()), state, action
        )
        assert [maker.next_atom() for _ in range(LENGTH + 1)] == [*decision.atoms, Atom.STOP]


def test_plan_is_kept_when_the_decision_is_to_wait(model: PaperModel) -> None:
    maker = DecisionMaker(model)
    known = Recognition("recognized", 0, int(np.flatnonzero(model.policy >= 0)[0]))
    plan = maker.decide(known).atoms
    assert maker.next_atom() == plan[0]
    assert maker.decide(Recognition("collecting", 1)) == PaperDecision("wait", ())
    assert maker.next_atom() == plan[1]
    assert maker.decide(Recognition("unknown", 2)) == PaperDecision("stop", (Atom.STOP,) * LENGTH)
    assert [maker.next_atom() for _ in range(LENGTH)] == [Atom.STOP] * LENGTH
    maker.decide(known)
    maker.reset()
    assert maker.next_atom() == Atom.STOP


def test_robot_stops_when_no_action_is_known() -> None:
    astray = drive(np.concatenate([corridor(20, seed=8, smooth=0.9), VIEWS]), 0, seed=4, end=20)
    model = learn([DRIVES[0], astray], LearningSettings(features=COLOR))
    assert model.states - np.unique(model.transitions.state).size == 1
    maker = DecisionMaker(model)
    stop = (Atom.STOP,) * LENGTH
    goal = int(model.transitions.goals[0])
    end = int(model.state_streams[1][-1])
    assert maker.decide(Recognition("recognized", 0, goal)) == PaperDecision("goal", stop, goal)
    assert maker.decide(Recognition("recognized", 5, end)) == PaperDecision("dead_end", stop, end)


@pytest.mark.parametrize("length", [2, 10])
def test_drive_is_repeated_when_it_is_seen_again(length: int) -> None:
    model = learn(DRIVES[:1], LearningSettings(features=COLOR, sequence_length=length, tau=0.6))
    recognizer = Recognizer(model)
    maker = DecisionMaker(model)
    one = DRIVES[0]
    first = len(one.atoms) % length
    made = []
    for tick, view in enumerate(one.features[first : first + 60]):
        maker.decide(recognizer.observe(tick, view, due=(tick + 1) % length == 0))
        made.append(maker.next_atom())
    taught = one.atoms[first : first + 60]
    assert np.mean(np.array(made)[length - 1 :] == taught[length - 1 :]) > 0.7
