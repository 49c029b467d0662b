"""The frame that a method takes the robot to be at: against a search through all of them, written plainly."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from smal.action_space import Atom
from smal.evaluation.localization import DemonstratedFrames, nearest_windows
from smal.features import FeatureSettings
from smal.learning import Demonstration, LearningSettings, learn
from smal.model import Model

LENGTH = 4


def taught(frames: tuple[int, ...] = (22, 17, 26), seed: int = 0) -> Model:
    """Learn drives through random places; the later ones pass places of the first again."""
    rng, features = np.random.default_rng(seed), FeatureSettings()
    places = rng.random((40, features.size), dtype=np.float32)
    drives = []
    for number, count in enumerate(frames):
        views = places[number * 2 : number * 2 + count] + 0.01 * rng.random((count, features.size), dtype=np.float32)
        atoms = np.full(count, Atom.FORWARD, dtype=np.int8)
        drives.append(Demonstration(f"drive-{number}", views, atoms))
    settings = LearningSettings(sequence_length=LENGTH, novelty_parameters={"min_agreement": 0.5})
    return learn(drives, settings)[0]


def test_a_template_is_where_it_was_demonstrated() -> None:
    model = taught()
    assert model.shared_states > 0
    frames, made, start = DemonstratedFrames(model), set(), 0
    for atoms, states in zip(model.atoms, model.state_streams, strict=True):
        begin, last = start + len(atoms) % LENGTH, start + len(atoms) - 1
        for number, state in enumerate(states.tolist()):
            if state not in made:
                for phase in range(2 * LENGTH - 1):
                    expected = min(begin + number * LENGTH + phase, last)
                    assert frames.frame(state, phase + 0.3) == expected, "and not beyond the demonstration"
            made.add(state)
        start += len(atoms)
    assert made == set(range(model.states))


@settings(max_examples=60, deadline=None)
@given(
    lengths=st.lists(st.integers(0, 9), min_size=1, max_size=4).filter(lambda each: max(each) > 0),
    count=st.integers(0, 12),
    data=st.data(),
    seed=st.integers(0, 2**31),
)
def test_nearest_windows_are_those_of_a_plain_search(
    lengths: list[int], count: int, data: st.DataObject, seed: int
) -> None:
    frames = data.draw(st.integers(1, max(lengths)))
    rng = np.random.default_rng(seed)
    drives = [rng.standard_normal((n, 5)).astype(np.float32) for n in lengths]
    queries = rng.standard_normal((count, 5)).astype(np.float32)
    best, score = nearest_windows(drives, queries, frames)
    starts = np.cumsum([0, *lengths])
    for t in range(count):
        if t < frames - 1:
            assert (best[t], score[t]) == (-1, 0.0)
            continue
        window = queries[t - frames + 1 : t + 1].astype(np.float64)
        apart = {
            int(start) + end: float(np.square(window - drive[end - frames + 1 : end + 1]).sum()) / frames
            for start, drive in zip(starts, drives, strict=False)
            for end in range(frames - 1, len(drive))
        }
        assert score[t] == pytest.approx(-min(apart.values()), rel=1e-4, abs=1e-5)
        assert apart[int(best[t])] == pytest.approx(min(apart.values()), rel=1e-4, abs=1e-5)


@pytest.mark.parametrize("frames", [0, 4])
def test_windows_that_no_demonstration_has(frames: int) -> None:
    views = np.zeros((3, 2), dtype=np.float32)
    with pytest.raises(ValueError, match=f"longest demonstration, got {frames}"):
        nearest_windows([views], views, frames)
