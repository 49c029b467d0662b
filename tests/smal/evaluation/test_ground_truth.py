"""Which references are right, from poses and from intervals."""

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from smal.evaluation.ground_truth import IntervalTruth, judge_by_poses
from smal.place_recognition import Matches


@given(st.integers(0, 2**32 - 1), st.floats(0.1, 3.0), st.floats(1.0, 179.0))
@settings(max_examples=50, deadline=None)
def test_poses_are_near_and_look_the_same_way(seed: int, distance_m: float, angle_deg: float) -> None:
    """Against the angle between the two directions as vectors; headings come with any number of turns."""
    rng = np.random.default_rng(seed)
    references, queries = (np.column_stack([rng.uniform(0, 4, (n, 2)), rng.uniform(-20, 20, n)]) for n in (30, 300))
    right = np.zeros((300, 30), dtype=bool)
    for j in range(30):
        judged = judge_by_poses(
            Matches(np.full(300, j), np.ones(300), np.zeros(300)), references, queries, distance_m, angle_deg
        )
        right[:, j] = judged.right
        assert judged.judged.all()
    assert judged.findable.tolist() == right.any(axis=1).tolist()
    for i in range(0, 300, 30):
        for j in range(30):
            (x, y, a), (u, v, b) = queries[i], references[j]
            cos = math.cos(a) * math.cos(b) + math.sin(a) * math.sin(b)
            apart_deg = math.degrees(math.acos(max(-1.0, min(1.0, cos))))
            assert right[i, j] == (math.dist((x, y), (u, v)) <= distance_m and apart_deg <= angle_deg)


def test_judging_takes_what_is_right_and_nothing_else() -> None:
    """Right; wrong; not judged; nothing to find; no answer; right at the second of two intervals."""
    intervals = np.array([[0, 2, 4], [1, 2, 4], [4, 0, 9], [5, 1, 2], [5, 7, 8]]).T
    truth = IntervalTruth(*intervals, np.array([1, 1, 0, 1, 1, 1], bool))
    matches = Matches(np.array([4, 5, 3, 3, -1, 7]), np.array([5.0, 4.0, 3.0, 2.0, 0.0, 1.0]), np.zeros(6))
    judgement = truth.judge(matches)
    assert judgement.right.tolist() == [True, False, False, False, False, True]
    assert judgement.answered.tolist() == [True, True, True, True, False, True]
    assert judgement.findable.tolist() == [True, True, False, False, True, True]
