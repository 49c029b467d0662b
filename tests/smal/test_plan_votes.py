"""Votes on atoms: each is made as often as it has votes, plans of before keep their share, and progress is seen."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from smal.action_space import Atom
from smal.plan_votes import PROGRESS_TICKS, PlanVotes, Progress

HORIZON = 12
TURN_AHEAD = [Atom.FORWARD] * 4 + [Atom.LEFT] * 5 + [Atom.FORWARD] * 2 + [Atom.RIGHT]

plans = st.lists(st.sampled_from(list(Atom)), min_size=HORIZON, max_size=HORIZON)


@given(steps=st.lists(st.tuples(plans, st.floats(0.0, 1.0)), min_size=1, max_size=30))
def test_nothing_is_owed_for_long_however_plans_persist(steps: list[tuple[list[Atom], float]]) -> None:
    """Atoms made and shares of votes differ by less than the number of atoms, at any time."""
    votes, asked, made = PlanVotes(HORIZON), np.zeros(len(Atom)), np.zeros(len(Atom))
    kept = np.empty((0, len(Atom)))
    for plan, persistence in steps:
        atom = votes.cast([(plan, 1.0)], persistence)[0]
        votes.made(atom)
        mixed = np.eye(len(Atom))[plan]
        if len(kept):
            mixed[: len(kept)] = persistence * kept + (1.0 - persistence) * mixed[: len(kept)]
        kept = mixed[1:]
        asked += mixed[0]
        made[atom] += 1
        assert np.abs(asked - made).max() < len(Atom)


@pytest.mark.parametrize("persistence", [0.0, 0.5, 0.9])
def test_a_plan_made_again_and_again_is_gone_into_as_far_as_plans_persist(persistence: float) -> None:
    votes, made = PlanVotes(HORIZON), []
    for _ in range(500):
        made.append(votes.cast([(TURN_AHEAD, 1.0)], persistence)[0])
        votes.made(made[-1])
    shares = [(1.0 - persistence) * persistence**j for j in range(HORIZON - 1)] + [persistence ** (HORIZON - 1)]
    for kind in Atom:
        share = sum(one for one, atom in zip(shares, TURN_AHEAD, strict=True) if atom == kind)
        assert made.count(kind) / len(made) == pytest.approx(share, abs=0.03)


def test_the_first_plan_decides_a_tie() -> None:
    left, right = [Atom.LEFT] * HORIZON, [Atom.RIGHT] * HORIZON
    assert PlanVotes(HORIZON).cast([(left, 1.0), (right, 1.0)], 0.0)[0] == Atom.LEFT
    assert PlanVotes(HORIZON).cast([(right, 1.0), (left, 1.0)], 0.0)[0] == Atom.RIGHT


def test_a_new_way_has_no_votes_of_the_old_one() -> None:
    votes = PlanVotes(HORIZON)
    votes.cast([([Atom.LEFT] * HORIZON, 1.0)], 0.0)
    votes.clear()
    assert votes.cast([([Atom.FORWARD] * HORIZON, 1.0)], 1.0) == (Atom.FORWARD,) * HORIZON


@pytest.mark.parametrize("stride", [1, 5, 20])
def test_a_demonstration_that_goes_by_is_progress_and_one_that_stays_is_none(stride: int) -> None:
    progress = Progress(stride)
    for frame in range(0, 10 * stride, stride):
        progress.follow(0, frame)
        assert progress.value == 1.0
    values = []
    for _ in range(0, 60, stride):
        progress.follow(0, frame)
        values.append(progress.value)
    assert all(later <= earlier for earlier, later in pairwise(values))
    assert values[-1] < 0.05
    progress.reset()
    assert progress.value == 1.0


def test_progress_is_an_average_over_a_turn() -> None:
    """Half the speed is half the progress; to and fro is none to speak of, nor is the way back."""
    slow, swinging, back = Progress(1), Progress(1), Progress(1)
    for tick in range(200):
        slow.follow(0, tick // 2)
        swinging.follow(0, 100 + tick % 2)
        back.follow(0, 300 - tick)
        assert min(slow.value, swinging.value, back.value) >= 0.0
    assert slow.value == pytest.approx(0.5, abs=1.0 / PROGRESS_TICKS)
    assert swinging.value == pytest.approx(0.0, abs=1.0 / PROGRESS_TICKS)
    assert back.value == 0.0


def test_other_demonstrations_and_other_parts_are_no_sign_of_being_stuck() -> None:
    jumping = Progress(1)
    for tick in range(50):
        jumping.follow(tick % 2, 7)
    assert jumping.value == 1.0
    for tick in range(50):
        jumping.follow(0, 100 * (tick % 2))
    assert jumping.value == 1.0
