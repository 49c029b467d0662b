"""Learning a corridor, then finding the way in it."""

import dataclasses

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from smal.action_space import Atom
from smal.alignment import CONCENTRATION
from smal.decision import COAST_TICKS, SETTLED_RESIDUAL, DecisionMaker
from smal.evaluation.baselines.seqslam_localisation import state_at
from smal.learning import Demonstration, LearningReport, LearningSettings, learn
from smal.matching.streaming import StreamingMatcher
from smal.model import Model
from smal.novelty import RECOGNITION_DEFAULTS
from smal.recognition import HIDDEN_TICKS, Candidate, Recognition, Recognizer
from smal.state_matching import Solution
from tests.smal.worlds import COLOR, corridor, drive, unit

PLACES, LENGTH = 120, 5
VIEWS = corridor(PLACES)
DRIVES = [drive(VIEWS, start, seed=start, name=f"drive {start}") for start in range(4)]
RECOVERY = dataclasses.replace(drive(VIEWS, 40, seed=9, name="recovery", end=72), recovery=True)


@pytest.fixture(scope="module")
def learned() -> tuple[Model, LearningReport]:
    return learn([*DRIVES, RECOVERY], LearningSettings(features=COLOR))


@pytest.fixture(scope="module")
def model(learned: tuple[Model, LearningReport]) -> Model:
    return learned[0]


def place_of(model: Model, recognition: Recognition) -> float:
    """Where along the corridor a recognition says that the robot is."""
    assert recognition.state is not None
    assert recognition.phase is not None
    for demonstration, stream in enumerate(model.state_streams):
        for index in np.flatnonzero(stream == recognition.state):
            frames = len(model.atoms[demonstration])
            last = frames % LENGTH + (index + 1) * LENGTH - 1
            start = [0, 1, 2, 3, 40][demonstration]
            return float(start + last + recognition.phase - model.phases[demonstration][index])
    raise AssertionError


def test_report(learned: tuple[Model, LearningReport]) -> None:
    model, report = learned
    assert report.demonstrations == 5
    assert report.frames == 120 + 119 + 118 + 117 + 32
    assert report.states == model.states < 60
    assert report.shared_states > 0.5 * report.states
    assert report.goals == 1
    assert report.reward_states >= 1
    assert set(report.seconds) == {"centering", "states", "transitions", "reward", "policy"}


def test_every_state_leads_to_the_goal(model: Model) -> None:
    T = model.transitions.matrix
    value = model.value
    assert model.reward[model.transitions.goals[0]] == pytest.approx(1.0)
    assert value[model.transitions.goals[0]] == pytest.approx(value.max())
    expert = model.transitions.expert_pairs()
    assert (T[expert] @ value > value - 1e-9).all()


def test_recognizer_localises_to_the_frame(model: Model) -> None:
    recognizer, query = Recognizer(model), drive(VIEWS, 3, seed=77)
    for tick, features in enumerate(query.features):
        recognition = recognizer.observe(tick, features, due=True)
        if tick < LENGTH - 1:
            assert recognition.status == "collecting"
            continue
        assert recognition.status == "recognized"
        assert place_of(model, recognition) == pytest.approx(3 + tick, abs=1.0)
        assert recognition.duality_gap <= 1e-3


def test_unrelated_views_are_unknown(model: Model) -> None:
    recognizer = Recognizer(model)
    strange = unit(np.random.default_rng(5).standard_normal((10, COLOR.size))).astype(np.float32)
    answers = [recognizer.observe(tick, view, due=True) for tick, view in enumerate(strange)]
    assert [one.status for one in answers] == ["collecting"] * 4 + ["unknown"] * 6
    assert all(one.state is None and one.phase is None for one in answers)


def test_zero_weights_are_no_state(model: Model) -> None:
    """Views equal to the mean have no direction: every weight is zero, which is not state 0."""
    recognizer = Recognizer(model)
    answers = [recognizer.observe(tick, model.mean, due=True) for tick in range(LENGTH)]
    assert answers[-1].status == "unknown"
    assert answers[-1].total_weight == 0.0


def test_streaming_agrees_with_a_fresh_recognizer(model: Model) -> None:
    query = drive(VIEWS, 10, seed=3).features[:23]
    streaming, fresh = Recognizer(model), Recognizer(model)
    answers = [streaming.observe(tick, view, due=tick % 4 == 0) for tick, view in enumerate(query)]
    again = [fresh.observe(tick, view, due=True) for tick, view in enumerate(query[16:21], start=16)]
    assert answers[20].state == again[-1].state
    assert answers[20].phase == pytest.approx(again[-1].phase, abs=0.05)
    assert answers[21].status == "collecting"


def test_a_gap_starts_the_window_anew(model: Model) -> None:
    recognizer, query = Recognizer(model), DRIVES[0].features
    for tick in range(8):
        recognizer.observe(tick, query[tick], due=True)
    answers = [recognizer.observe(tick, query[tick], due=True) for tick in range(9, 15)]
    assert [one.status for one in answers] == ["recognized"] * 6
    # Halves of l for which there are frames.
    assert [one.frames for one in answers] == [1, 2, 2, 2, 5, 5]
    recognizer.reset()
    assert recognizer.observe(15, query[15], due=True).status == "collecting"


def test_in_the_scheme_of_the_paper_a_window_is_whole(model: Model) -> None:
    recognizer, query = Recognizer(model, shorten=False), DRIVES[0].features
    statuses = [recognizer.observe(tick, query[tick], due=True).status for tick in (*range(6), *range(7, 13))]
    assert statuses == ["collecting"] * 4 + ["recognized"] * 2 + ["collecting"] * 4 + ["recognized"] * 2


@pytest.mark.parametrize("loss", [0.05, 0.2])
def test_lost_frames_hardly_blind_the_robot(loss: float) -> None:
    """A window of 20 frames is seldom whole then."""
    model, _ = learn([*DRIVES, RECOVERY], LearningSettings(features=COLOR, sequence_length=20))
    recognizer, query = Recognizer(model), drive(VIEWS, 1, seed=12)
    arrive = np.random.default_rng(1).random(len(query.features)) >= loss
    arrive[:20] = True
    answers = [recognizer.observe(tick, query.features[tick], due=True) for tick in np.flatnonzero(arrive)]
    known = [one.status == "recognized" for one in answers]
    assert np.mean(known[20:]) > 0.95


def test_negative_weights_alone_show_no_state(model: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """The paper's test counts them as they are; but what resembles the opposite of a state is not that state."""
    recognizer = Recognizer(dataclasses.replace(model, novelty="weight", recognition_parameters={"tau": 0.1}))
    for tick in range(LENGTH):
        answer = recognizer.observe(tick, DRIVES[0].features[40 + tick], due=True)
    assert answer.status == "recognized"
    match = StreamingMatcher.match

    def opposite(matcher: StreamingMatcher, frames: int | None = None) -> Solution:
        solution = match(matcher, frames)
        return dataclasses.replace(solution, active_weights=-np.abs(solution.active_weights))

    monkeypatch.setattr(StreamingMatcher, "match", opposite)
    answer = recognizer.observe(LENGTH, DRIVES[0].features[40 + LENGTH], due=True)
    assert (answer.status, answer.candidates) == ("unknown", ())
    assert answer.score > 0.1


def test_bad_features_are_refused_and_not_taken_in(model: Model) -> None:
    recognizer, query = Recognizer(model), DRIVES[0].features
    for tick in range(4):
        recognizer.observe(tick, query[tick], due=True)
    for bad in (
        np.full(COLOR.size, np.nan, np.float32),
        np.zeros(3, np.float32),
        np.zeros((2, COLOR.size), np.float32),
    ):
        with pytest.raises(ValueError, match="features"):
            recognizer.observe(4, bad, due=True)
    assert recognizer.observe(4, query[4], due=True).status == "recognized"


@pytest.mark.parametrize("stride", [1, 3, 5])
def test_decisions_follow_the_expert(model: Model, stride: int) -> None:
    """Most atoms are those of the expert at the same place; near a turn a few come a little early or late."""
    recognizer, maker = Recognizer(model), DecisionMaker(model, stride)
    query = drive(VIEWS, 2, seed=50)
    right = total = 0
    for tick, view in enumerate(query.features[:-5]):
        due = tick >= LENGTH - 1 and (tick - LENGTH + 1) % stride == 0
        maker.decide(recognizer.observe(tick, view, due))
        atom = maker.next_atom()
        if tick >= LENGTH - 1:
            right, total = right + int(atom == query.atoms[tick]), total + 1
        else:
            assert atom == Atom.STOP
    assert right / total > 0.8


def test_goal_finishes_the_drive_then_stops(model: Model) -> None:
    maker = DecisionMaker(model, LENGTH)
    goal = int(model.transitions.goals[0])
    decision = maker.decide(Recognition("recognized", 0, goal, float(model.phases[0][-1]) - 2.0))
    assert decision.kind == "goal"
    assert decision.demonstration is not None
    assert decision.frame is not None
    tail = model.atoms[decision.demonstration][decision.frame :]
    expected = [*tail.tolist(), *[Atom.STOP] * 5][:5]
    assert [maker.next_atom() for _ in range(5)] == expected
    assert maker.next_atom() == Atom.STOP


def test_unknown_looks_around_for_a_bounded_time(model: Model) -> None:
    maker = DecisionMaker(model, stride=5, look_around_ticks=12)
    atoms = []
    kinds = []
    for tick in range(4):
        kinds.append(maker.decide(Recognition("unknown", tick)).kind)
        atoms += [maker.next_atom() for _ in range(5)]
    assert kinds == ["look_around"] * 3 + ["stop"]
    assert atoms == [Atom.LEFT] * 12 + [Atom.STOP] * 8
    maker.decide(Recognition("recognized", 5, 0, 2.0))
    assert maker.decide(Recognition("unknown", 6)).kind == "look_around"


def test_waiting_keeps_the_plan(model: Model) -> None:
    maker = DecisionMaker(model, LENGTH)
    plan = maker.decide(Recognition("recognized", 0, 3, 4.0)).atoms
    assert maker.next_atom() == plan[0]
    assert maker.decide(Recognition("collecting", 1)).kind == "wait"
    assert maker.next_atom() == plan[1]
    maker.reset()
    assert maker.next_atom() == Atom.STOP


def test_unaligned_is_the_scheme_of_the_paper(model: Model) -> None:
    state = int(model.state_streams[0][5])
    decision = DecisionMaker(model, LENGTH, aligned=False).decide(Recognition("recognized", 0, state, 6.5))
    assert decision.action is not None
    assert list(decision.atoms) == model.actions[decision.action].tolist()


def test_dead_end_finishes_the_drive_then_looks_around() -> None:
    elsewhere = corridor(20, seed=8, smooth=0.9)
    astray = drive(np.concatenate([elsewhere, VIEWS]), 0, seed=4, end=20)
    model, report = learn([DRIVES[0], astray], LearningSettings(features=COLOR))
    assert report.dead_ends == 1
    state = int(model.state_streams[1][-1])
    maker = DecisionMaker(model, LENGTH)
    assert maker.decide(Recognition("recognized", 0, state, 2.0)).kind == "dead_end"
    assert maker.decide(Recognition("recognized", 5, state, 6.0)).kind == "look_around"


@pytest.mark.parametrize(("stride", "ticks"), [(0, 5), (6, 5), (2, -1)])
def test_bad_decision_settings_are_refused(model: Model, stride: int, ticks: int) -> None:
    with pytest.raises(ValueError, match=r"stride|look_around"):
        DecisionMaker(model, stride, ticks)


@pytest.mark.parametrize("novelty", ["weight", "agreement"])
@pytest.mark.parametrize("length", [1, 2, 10])
def test_other_lengths_and_tests(novelty: str, length: int) -> None:
    model, _ = learn(DRIVES[:2], LearningSettings(features=COLOR, sequence_length=length, novelty=novelty))
    recognizer, maker = Recognizer(model), DecisionMaker(model, length)
    for tick, view in enumerate(drive(VIEWS, 0, seed=31).features[:30]):
        recognition = recognizer.observe(tick, view, due=True)
        maker.decide(recognition)
        maker.next_atom()
    assert recognition.status == "recognized"


def test_bad_demonstrations_and_settings_are_refused() -> None:
    with pytest.raises(ValueError, match="no demonstration"):
        learn([], LearningSettings(features=COLOR))
    with pytest.raises(ValueError, match="settings ask for"):
        learn([DRIVES[0]], LearningSettings())
    with pytest.raises(ValueError, match="goal"):
        learn([RECOVERY], LearningSettings(features=COLOR))
    with pytest.raises(ValueError, match="do not fit"):
        Demonstration("x", DRIVES[0].features, DRIVES[0].atoms[:-1])
    for name, value, error in (
        ("sequence_length", 0, "sequence_length must be at least 1, got 0"),
        ("lambda1", 0.0, "lambda1 must be finite and positive, got 0.0"),
        ("gamma", 1.0, "gamma"),
        ("novelty", "x", "unknown novelty test 'x'"),
    ):
        with pytest.raises(ValueError, match=error):
            LearningSettings(features=COLOR, **{name: value})


def turning_and_straight(model: Model) -> tuple[Candidate, Candidate]:
    """Two states, as certain as can be, whose policies differ from the first atom on."""
    maker = DecisionMaker(model, LENGTH, belief=False)
    plans = {
        state: maker.decide(Recognition("recognized", 0, state, LENGTH - 1.0)).atoms for state in range(model.states)
    }
    straight = next(state for state, atoms in plans.items() if atoms == (Atom.FORWARD,) * LENGTH)
    turning = next(state for state, atoms in plans.items() if atoms == (Atom.LEFT,) * LENGTH)
    return Candidate(turning, LENGTH - 1.0, 0.6), Candidate(straight, LENGTH - 1.0, 0.4)


@settings(deadline=None, max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(share=st.floats(0.02, 0.98), stride=st.integers(1, LENGTH), decisions=st.integers(1, 12))
def test_every_movement_is_made_as_often_as_states_ask_for_it(
    model: Model, share: float, stride: int, decisions: int
) -> None:
    turning, straight = turning_and_straight(model)
    candidates = (dataclasses.replace(turning, weight=share), dataclasses.replace(straight, weight=1.0 - share))
    maker = DecisionMaker(model, stride)
    atoms = []
    for tick in range(decisions):
        maker.decide(Recognition("recognized", tick, turning.state, turning.phase, candidates=candidates))
        atoms += [maker.next_atom() for _ in range(stride)]
        turns = share * len(atoms)
        assert abs(atoms.count(Atom.LEFT) - turns) < 1.0
        assert abs(atoms.count(Atom.FORWARD) - (len(atoms) - turns)) < 1.0


def atoms_while_stuck(model: Model, explained: float) -> list[Atom]:
    """Drive on while every view is that of a state whose plan has a turn to come."""
    plans = DecisionMaker(model, LENGTH)
    for state in range(model.states):
        plan = plans.decide(Recognition("recognized", 0, state, LENGTH - 1.0)).atoms
        if plan[0] == Atom.FORWARD and Atom.LEFT in plan:
            break
    else:
        raise AssertionError("no state is followed by a turn")
    here = Recognition(
        "recognized", 0, state, LENGTH - 1.0, candidates=(Candidate(state, LENGTH - 1.0, 1.0),), explained=explained
    )
    maker, atoms = DecisionMaker(model, 1), []
    for _ in range(60):
        maker.decide(here)
        atoms.append(maker.next_atom())
    return atoms


def test_a_turn_to_come_is_made_although_the_view_stays_the_same(model: Model) -> None:
    turns = [atoms_while_stuck(model, explained).count(Atom.LEFT) for explained in (1.0, 0.7, 0.4, 0.1)]
    assert turns[0] == 0, "a robot that knows where it is follows its latest plan alone"
    assert turns == sorted(turns)
    assert 5 < turns[-1] < 50


def test_a_robot_that_moves_along_follows_its_latest_plan_alone(model: Model) -> None:
    """At twice the speed of the demonstration the plan of before is behind, and has no say."""
    known, vague = DecisionMaker(model, 1), DecisionMaker(model, 1)
    made = []
    for tick, frame in enumerate(range(LENGTH, len(model.atoms[0]) - 2 * LENGTH, 2)):
        state, phase = state_at(model, 0, frame)
        seen = Recognition("recognized", tick, state, phase, candidates=(Candidate(state, phase, 1.0),))
        known.decide(seen)
        vague.decide(dataclasses.replace(seen, explained=0.0))
        made.append((known.next_atom(), vague.next_atom()))
    assert {Atom.FORWARD, Atom.LEFT} <= {one for one, _ in made}
    assert all(one == other for one, other in made)


def test_the_less_templates_explain_the_more_plans_of_before_say(model: Model) -> None:
    """What is explained is told by recognition: much of a taught drive, less where noise is added."""
    rng, told = np.random.default_rng(3), []
    for noise in (0.0, 0.5, 1.5):
        recognizer = Recognizer(model)
        found = [
            recognizer.observe(tick, frame + noise * rng.standard_normal(frame.size) / np.sqrt(frame.size), True)
            for tick, frame in enumerate(DRIVES[0].features[:12])
        ]
        told.append(np.mean([one.explained for one in found if one.status == "recognized"]))
    assert 1.0 >= told[0] > told[1] > told[2] > 0.0
    paper = Recognizer(model, shorten=False)
    assert {paper.observe(tick, one, True).explained for tick, one in enumerate(DRIVES[0].features[:12])} == {1.0}


def test_what_is_owed_is_forgotten_with_the_way(model: Model) -> None:
    turning, straight = turning_and_straight(model)
    candidates = tuple(dataclasses.replace(one, weight=0.5) for one in (straight, turning))
    maker, fresh = DecisionMaker(model, 1), DecisionMaker(model, 1)
    seen = Recognition("recognized", 0, straight.state, straight.phase, residual=0.1, candidates=candidates)
    maker.decide(seen)
    maker.next_atom()
    assert maker.decide(seen).atoms != fresh.decide(seen).atoms
    while maker.decide(Recognition("unknown", 1)).kind != "look_around":
        maker.next_atom()
    assert maker.decide(seen).atoms == fresh.decide(seen).atoms


def test_the_scheme_of_the_paper_asks_the_heaviest_state_alone(model: Model) -> None:
    turning, straight = turning_and_straight(model)
    seen = Recognition("recognized", 0, turning.state, turning.phase, candidates=(turning, straight))
    assert DecisionMaker(model, LENGTH, belief=False).decide(seen).atoms == (Atom.LEFT,) * LENGTH


def test_looking_around_goes_on_until_a_view_is_really_known(model: Model) -> None:
    maker = DecisionMaker(model, LENGTH)
    assert maker.decide(Recognition("unknown", 0)).kind == "look_around"
    vague = Recognition("recognized", 5, 0, 2.0, residual=SETTLED_RESIDUAL + 0.1)
    assert maker.decide(vague).kind == "look_around"
    clear = dataclasses.replace(vague, residual=SETTLED_RESIDUAL - 0.1)
    assert maker.decide(clear).kind == "action"
    assert maker.decide(vague).kind == "action"


def test_a_vague_view_will_do_after_a_whole_turn(model: Model) -> None:
    maker = DecisionMaker(model, LENGTH, look_around_ticks=10)
    vague = Recognition("recognized", 5, 0, 2.0, residual=SETTLED_RESIDUAL + 0.1)
    kinds = []
    for seen in (Recognition("unknown", 0), vague, vague):
        kinds.append(maker.decide(seen).kind)
        for _ in range(LENGTH):
            maker.next_atom()
    assert kinds == ["look_around", "look_around", "action"]


def test_turns_that_a_new_plan_replaces_are_not_spent(model: Model) -> None:
    maker = DecisionMaker(model, stride=1, look_around_ticks=12)
    atoms = []
    for _ in range(15):
        maker.decide(Recognition("unknown", 0))
        atoms.append(maker.next_atom())
    assert atoms == [Atom.LEFT] * 12 + [Atom.STOP] * 3


def test_a_late_decision_finds_the_plan_going_on(model: Model) -> None:
    maker = DecisionMaker(model, stride=1)
    decision = maker.decide(Recognition("recognized", 5, 0, LENGTH - 1.0, residual=0.0))
    taken = [maker.next_atom() for _ in range(LENGTH + 2)]
    assert tuple(taken[:LENGTH]) == decision.atoms, "as the paper does with all l atoms of an action"
    assert taken[LENGTH:] == [Atom.STOP] * 2, "and no further"


LONG = 20


@pytest.fixture(scope="module")
def long_model() -> Model:
    return learn(DRIVES, LearningSettings(features=COLOR, sequence_length=LONG))[0]


def back_on_the_way(model: Model, shorten: bool, taught: int) -> Recognition:
    """Show a robot views that nobody taught, and then a few that were."""
    rng = np.random.default_rng(5)
    recognizer = Recognizer(model, shorten=shorten)
    untaught = unit(rng.standard_normal((LONG, VIEWS.shape[1])))
    seen = np.concatenate([untaught, VIEWS[50 : 50 + taught]]).astype(np.float32)
    return [recognizer.observe(tick, view, due=True) for tick, view in enumerate(seen)][-1]


@pytest.mark.parametrize("taught", [1, 2])
def test_a_shorter_window_knows_the_way_again_at_once(long_model: Model, taught: int) -> None:
    assert back_on_the_way(long_model, shorten=False, taught=taught).status == "unknown"
    found = back_on_the_way(long_model, shorten=True, taught=taught)
    assert found.status == "recognized"
    assert found.frames < LONG
    assert found.residual < back_on_the_way(long_model, shorten=False, taught=taught).residual


def test_a_known_window_is_not_shortened(long_model: Model) -> None:
    long, short = (back_on_the_way(long_model, shorten, taught=LONG) for shorten in (False, True))
    # The belief differs a little: what is explained less counts less.
    assert dataclasses.replace(long, candidates=()) == dataclasses.replace(short, candidates=(), explained=1.0)
    assert long.candidates[0].state == short.candidates[0].state
    assert long.status == "recognized"
    assert long.frames == LONG


def test_untaught_views_are_unknown_at_every_length(long_model: Model) -> None:
    found = back_on_the_way(long_model, shorten=True, taught=0)
    assert found.status == "unknown"
    assert found.frames == LONG


def test_the_belief_is_about_now(model: Model) -> None:
    """Of two places that one window shows, the later has more say the shorter the memory."""
    seen = np.concatenate([VIEWS[20:23], VIEWS[80:82]]).astype(np.float32)

    def late_share(recency_ticks: float) -> float:
        recognizer = Recognizer(model, recency_ticks=recency_ticks)
        found = [recognizer.observe(tick, view, due=True) for tick, view in enumerate(seen)][-1]
        places = [place_of(model, dataclasses.replace(found, state=c.state, phase=c.phase)) for c in found.candidates]
        return sum(c.weight for c, place in zip(found.candidates, places, strict=True) if place > 50)

    shares = [late_share(ticks) for ticks in (np.inf, 3.0, 0.5)]
    assert shares == sorted(shares)
    assert shares[0] < 0.5 < shares[1] < shares[2]


def share_at(model: Model, recognition: Recognition, place: float) -> float:
    """Return the share of the belief within two frames of a place."""
    found = [
        (place_of(model, dataclasses.replace(recognition, state=one.state, phase=one.phase)), one.weight)
        for one in recognition.candidates
    ]
    return sum(weight for where, weight in found if abs(where - place) <= 2.0)


def test_what_explains_the_light_is_no_evidence_for_a_place(model: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = DRIVES[0].features - model.mean
    # All views have something in common now that only one demonstrated place had.
    seen = model.mean + frames[40:46] + 0.7 * frames[90]
    shares = {}
    for concentration in (0.0, CONCENTRATION):
        monkeypatch.setattr("smal.alignment.CONCENTRATION", concentration)
        recognizer = Recognizer(model)
        for tick, view in enumerate(seen):
            found = recognizer.observe(tick, view, True)
        assert found.status == "recognized"
        shares[concentration] = (share_at(model, found, 45), share_at(model, found, 90))
    assert shares[0.0][1] > 0.15
    assert shares[CONCENTRATION][0] > 0.95


def test_an_impossible_memory_is_refused(model: Model) -> None:
    with pytest.raises(ValueError, match="recency_ticks"):
        Recognizer(model, recency_ticks=0.0)


def coasting(model: Model, stride: int, unknown: int) -> tuple[list[str], list[Atom]]:
    """Decide once by a known state of a straight stretch, then while nothing is known."""
    maker = DecisionMaker(model, stride, belief=False)
    state = int(model.state_streams[0][0])
    seen = [
        Recognition("recognized", 0, state, float(LENGTH - 1)),
        *[Recognition("unknown", t) for t in range(unknown)],
    ]
    kinds, atoms = [], []
    for recognition in seen:
        kinds.append(maker.decide(recognition).kind)
        atoms += [maker.next_atom() for _ in range(stride)]
    return kinds, atoms


def test_a_moment_without_a_state_does_not_change_the_plan(model: Model) -> None:
    kinds, atoms = coasting(model, 1, 5)
    assert kinds == ["action", "coast", "coast", "coast", "look_around", "look_around"]
    maker = DecisionMaker(model, LENGTH, belief=False)
    plan = maker.decide(Recognition("recognized", 0, int(model.state_streams[0][0]), float(LENGTH - 1))).atoms
    assert tuple(atoms[: COAST_TICKS + 1]) == plan[: COAST_TICKS + 1]
    assert atoms[COAST_TICKS + 1 :] == [Atom.LEFT] * 2


@pytest.mark.parametrize(("stride", "coasts"), [(1, 3), (2, 1), (3, 1), (4, 0), (LENGTH, 0)])
def test_coasting_is_bounded_in_frames_and_not_in_decisions(model: Model, stride: int, coasts: int) -> None:
    kinds, _ = coasting(model, stride, 5)
    assert kinds.count("coast") == coasts
    assert kinds[coasts + 1 :] == ["look_around"] * (5 - coasts)


def test_a_robot_that_looks_around_or_stands_does_not_coast(model: Model) -> None:
    maker = DecisionMaker(model, stride=1, look_around_ticks=2)
    kinds = []
    for tick in range(5):
        kinds.append(maker.decide(Recognition("unknown", tick)).kind)
        maker.next_atom()
    assert kinds == ["look_around", "look_around", "stop", "stop", "stop"]


def test_recognition_parameters_that_are_not_given_are_those_of_execution() -> None:
    default = LearningSettings(features=COLOR)
    assert default.recognition == RECOGNITION_DEFAULTS["agreement"]
    loose = LearningSettings(features=COLOR, recognition_parameters={"max_residual": 0.95})
    assert loose.recognition == {**RECOGNITION_DEFAULTS["agreement"], "max_residual": 0.95}


@pytest.mark.parametrize("length", [1, 2, LENGTH])
def test_whatever_its_windows_the_robot_goes_on_as_long_when_the_view_is_hidden(length: int) -> None:
    """A plan of one movement is made again: peers with short windows must not be blinder than others."""
    model, _ = learn(DRIVES, LearningSettings(features=COLOR, sequence_length=length))
    maker, recognizer = DecisionMaker(model), Recognizer(model)
    for tick in range(length):
        seen = recognizer.observe(tick, DRIVES[0].features[60 + tick], due=True)
    assert maker.decide(seen).kind == "action"
    first = maker.next_atom()
    kinds = []
    for tick in range(COAST_TICKS + 1):
        kinds.append(maker.decide(Recognition("unknown", tick)).kind)
        atom = maker.next_atom()
        assert length > 1 or atom == first or kinds[-1] == "look_around"
    assert kinds == ["coast"] * COAST_TICKS + ["look_around"]


def test_without_coasting_it_looks_around_at_once(model: Model) -> None:
    maker = DecisionMaker(model, coast=False)
    maker.decide(Recognition("recognized", 0, 3, 4.0))
    maker.next_atom()
    assert maker.decide(Recognition("unknown", 1)).kind == "look_around"


def test_a_robot_that_stands_does_not_coast(model: Model) -> None:
    assert DecisionMaker(model).decide(Recognition("unknown", 0)).kind == "look_around"


def test_hidden_frames_do_not_move_the_belief(model: Model) -> None:
    """Of the last five frames two or three show nothing that was taught; the state is that of the others, gone on."""
    rng, recognizer = np.random.default_rng(8), Recognizer(model)
    query = drive(VIEWS, 3, seed=78).features.copy()
    hidden = np.zeros(len(query), dtype=bool)
    for start in range(10, 100, 6):
        hidden[start : start + 2 + start % 2] = True
    query[hidden] = unit(rng.standard_normal((hidden.sum(), query.shape[1]))) * np.linalg.norm(query[0])
    for tick, features in enumerate(query):
        recognition = recognizer.observe(tick, features, due=True)
        if 10 <= tick < 100:
            assert recognition.status == "recognized"
            (best, *_) = recognition.candidates
            place = place_of(model, dataclasses.replace(recognition, state=best.state, phase=best.phase))
            assert place == pytest.approx(3 + tick, abs=2.0)


def test_where_the_last_frames_are_hidden_nothing_is_known(model: Model) -> None:
    rng, recognizer = np.random.default_rng(9), Recognizer(model)
    statuses = []
    for tick in range(20):
        hidden = unit(rng.standard_normal((1, COLOR.size)))[0].astype(np.float32)
        view = DRIVES[0].features[30 + tick] if tick < 10 else model.mean + hidden
        statuses.append(recognizer.observe(tick, view, due=True).status)
    assert statuses[4:10] == ["recognized"] * 6
    assert statuses[10 + HIDDEN_TICKS :] == ["unknown"] * (10 - HIDDEN_TICKS)
