"""Teaching by people: corrected mistakes are not repeated, and pauses do not matter."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from smal.filter import Filter
from smal.keyframes import shows_same, without_detours
from smal.movement import Atom, dead_reckoning
from smal.planning import Planner, cost_to_go
from tests.smal.synthetic_world import SCENE, START, Drive, Room, drive, driven, taught

LENGTH_M = 2.0
MOVEMENTS = np.array([[0.0, 0.0], [0.05, 0.0], [-0.05, 0.0], [0.0, 0.08], [0.0, -0.08]])
#: Into a wrong way, back out of it, and on; to the wrong side; too far, and back.
MISTAKES = {
    "wrong way": ((1.2, 70.0), (0.5, 0.0), (-0.5, -70.0), (1.3, 0.0)),
    "wrong side": ((1.2, 70.0), (0.0, -70.0), (1.3, 0.0)),
    "too far": ((1.9, 0.0), (-0.7, 0.0), (1.3, 0.0)),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_corrected_mistake_is_not_repeated(mistake: str) -> None:
    straight = drive(START, ((2.5, 0.0),))
    wrong = drive(START, MISTAKES[mistake])
    found, centering = taught(Room(), wrong, scene=SCENE)
    planner = Planner(found)
    pose = driven(
        Filter(found, centering), planner, Room(), START, round(1.4 * len(straight.poses))
    )
    assert planner.said
    assert math.hypot(*(pose - straight.poses[-1])[:2]) < 0.25


@given(st.lists(st.tuples(st.sampled_from(Atom), st.integers(1, 20)), min_size=1, max_size=7))
def test_way_has_no_detours_and_no_gaps(
    keys: list[tuple[Atom, int]],
) -> None:
    atoms = np.repeat([key for key, _ in keys], [frames for _, frames in keys])
    poses = dead_reckoning(atoms, MOVEMENTS)
    on = without_detours(poses, np.zeros(len(poses), dtype=np.int32), LENGTH_M)
    way = poses[on]
    assert on[0]
    assert on[-1]
    assert all(
        shows_same(after[None], before, LENGTH_M)[0] for before, after in itertools.pairwise(way)
    )
    steps = np.hypot(*np.diff(way[:, :2], axis=0).T)
    for first in range(len(way)):
        same = shows_same(way[first + 1 :], way[first], LENGTH_M)
        apart = np.hypot(*(way[first + 1 :] - way[first])[:, :2].T)
        back = np.flatnonzero(same & (apart < np.cumsum(steps[first:]) / 2.0))
        assert same[: back.max(initial=-1) + 1].all()


def test_detour_round_a_post_is_kept() -> None:
    turn = [Atom.LEFT] * 10
    ahead = [Atom.FORWARD] * 4
    atoms = [*ahead, *turn, *ahead, *[Atom.RIGHT] * 20, *ahead, *turn, *ahead, Atom.STOP]
    poses = dead_reckoning(np.array(atoms), MOVEMENTS)
    on = without_detours(poses, np.zeros(len(poses), dtype=np.int32), 5.0)
    assert poses[on, 1].max() == pytest.approx(poses[:, 1].max())


def test_pause_teaches_no_longer_way() -> None:
    usual = drive(START, ((2.5, 0.0),))
    stands = Drive(
        np.insert(usual.poses, 20, usual.poses[[20] * 100], axis=0),
        np.insert(usual.atoms, 20, [0] * 100),
    )
    costs = [
        cost_to_go(taught(Room(), each, scene=SCENE)[0], "victim")[0][0] for each in (usual, stands)
    ]
    assert costs[1] == pytest.approx(costs[0], rel=0.05)
