"""SeqSLAM against its equations, term by term, and on traverses of known speed."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from smal.place_recognition.matches import NONE, ignore
from smal.place_recognition.seqslam import HALF_WINDOW, VELOCITIES, match_seqslam
from tests.smal.place_recognition.traverses import Road, random_features


@dataclass
class ByHand:
    """The equations of `match_seqslam` with loops, in double precision."""

    references: NDArray[np.float32]
    queries: NDArray[np.float32]
    length: int

    def __post_init__(self) -> None:
        self.enhanced = [self._enhanced_row(t) for t in range(len(self.queries))]

    def _enhanced_row(self, t: int) -> list[float]:
        row = [
            float(np.mean(np.abs(self.queries[t].astype(float) - x.astype(float))))
            for x in self.references
        ]
        result = []
        for i, value in enumerate(row):
            around = [row[j] for j in range(len(row)) if abs(j - i) <= HALF_WINDOW]
            result.append(
                float((value - np.mean(around)) / np.std(around)) if np.std(around) > 1e-9 else 0.0
            )
        return result

    def cost(self, t: int, end: int) -> float:
        """S(t, e)."""
        least = math.inf
        for velocity in VELOCITIES:
            steps = [math.floor(velocity * k + 0.5) for k in range(self.length)]
            if end - steps[-1] >= 0:
                least = min(
                    least,
                    float(np.mean([self.enhanced[t - k][end - s] for k, s in enumerate(steps)])),
                )
        return least

    def uniqueness(self, costs: list[float], best: int) -> float:
        """Return the score, given which end is the best."""
        offset = math.sqrt(2 * HALF_WINDOW + 1)
        outside = [c for e, c in enumerate(costs) if abs(e - best) > HALF_WINDOW and c < math.inf]
        second = min(outside, default=0.0) + offset
        return 1.0 - min(1.0, (costs[best] + offset) / second)


@given(st.integers(0, 2**32 - 1), st.integers(1, 25), st.integers(0, 14), st.integers(1, 6))
@settings(max_examples=60)
def test_equals_the_equations(seed: int, n: int, q: int, length: int) -> None:
    rng = np.random.default_rng(seed)
    references = random_features(rng, n)
    queries = random_features(rng, q)
    matches = match_seqslam(references, queries, length, ignore)
    hand = ByHand(references, queries, length)
    for t in range(q):
        costs = [hand.cost(t, e) for e in range(n)] if t >= length - 1 and n >= length else []
        if min(costs, default=math.inf) == math.inf:
            assert matches.reference[t] == NONE
            continue
        # Which of two ends it is may differ by rounding where they are as good.
        assert costs[matches.reference[t]] == pytest.approx(min(costs), abs=1e-4)
        assert matches.score[t] == pytest.approx(
            hand.uniqueness(costs, int(matches.reference[t])), abs=1e-3
        )


@pytest.mark.parametrize("velocity", VELOCITIES)
def test_other_speeds_are_recognized(velocity: float) -> None:
    """The queries come at another speed, under other light: every match ends where the query is."""
    rng = np.random.default_rng(1)
    road = Road(rng)
    references = road.at(np.arange(150.0))
    positions = 20.0 + velocity * np.arange(90)
    queries = 0.5 * road.at(positions) + rng.normal(scale=0.3, size=(90, 64)).astype(np.float32)
    matches = match_seqslam(references, queries, 20, ignore)
    assert np.abs(matches.reference[19:] - positions[19:]).max() <= 1.5


def test_rounding_is_no_contrast() -> None:
    """References with the same numbers in another order are equally far from 0, but for the rounding of sums."""
    rng = np.random.default_rng(7)
    references = np.array(
        [rng.permutation(np.linspace(0.1, 0.7, 2048)) for _ in range(40)], dtype=np.float32
    )
    matches = match_seqslam(references, np.zeros((15, 2048), dtype=np.float32), 10, ignore)
    assert matches.score.max() == 0.0
