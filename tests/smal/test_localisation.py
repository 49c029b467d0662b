"""The frame that a method takes the robot to be at: against a search through all of them, written plainly."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from smal.action_space import Atom
from smal.evaluation.localisation import DemonstratedFrames, nearest_windows
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


def test_every_demonstrated_sequence_is_where_it_ended() -> None:
    model = taught()
    assert model.shared_states > 0
    frames, start = DemonstratedFrames(model), 0
    for atoms, states, phases in zip(model.atoms, model.state_streams, model.phases, strict=True):
        ends = start + len(atoms) % LENGTH + LENGTH * np.arange(1, len(states) + 1) - 1
        for state, phase, end in zip(states.tolist(), phases.tolist(), ends.tolist(), strict=True):
            again = [s for d in range(3) for s, p in zip(model.state_streams[d], model.phases[d], strict=True)
                     if s == state and p == np.float32(phase)]  # fmt: skip
            if len(again) == 1:
                assert frames.frame(state, phase) == end
        start += len(atoms)


def test_a_later_phase_is_a_later_frame_of_the_same_demonstration() -> None:
    model = taught()
    frames, start = DemonstratedFrames(model), 0
    for number, atoms in enumerate(model.atoms):
        last = start + len(atoms) - 1
        state, phase = int(model.state_streams[number][-1]), float(model.phases[number][-1])
        occurrences = sum(int((stream == state).sum()) for stream in model.state_streams)
        if occurrences == 1:
            assert frames.frame(state, phase - 2.0) == last - 2
            assert frames.frame(state, phase + 5.0) == last, "not beyond the demonstration"
        start += len(atoms)


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
