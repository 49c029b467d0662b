"""SeqSLAM frame by frame finds what SeqSLAM over a whole traverse finds, and keeps demonstrations apart."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from smal.demonstration import Demonstration
from smal.evaluation.baselines.seqslam_localization import SeqSlamImitation, SeqSlamLocalizer
from smal.features.thumbnail import thumbnail_descriptor
from smal.movement import Atom
from smal.place_recognition.seqslam import SeqSlamSettings, match_seqslam
from tests.services.chain import picture

SETTINGS = SeqSlamSettings(length=6, window=10)


def traverse(frames: int, seed: int, noise: float = 0.0, noise_seed: int = 0) -> NDArray[np.float32]:
    """Return what SeqSLAM sees of images that glide over a wide random picture."""
    rng = np.random.default_rng(seed)
    wide = np.kron(rng.integers(0, 255, (12, 16 + frames), dtype=np.uint8), np.ones((4, 4), dtype=np.uint8))
    images = np.stack([wide[:, 4 * k : 4 * k + 64] for k in range(frames)])[..., np.newaxis].repeat(3, axis=3)
    spoilt = images + noise * np.random.default_rng(noise_seed).standard_normal(images.shape)
    return np.stack([thumbnail_descriptor(image) for image in np.clip(spoilt, 0, 255).astype(np.uint8)])


@pytest.mark.parametrize("noise", [0.0, 30.0, 120.0])
def test_one_demonstration_is_matched_as_by_seqslam_over_the_whole_traverse(noise: float) -> None:
    references, queries = traverse(40, 1), traverse(40, 1, noise, 7)[5:30]
    whole = match_seqslam(references, queries, SETTINGS, lambda _done: None)
    localizer = SeqSlamLocalizer([references], SETTINGS)
    found = [localizer.observe(image) for image in queries]
    assert [-1 if place is None else place.frame for place in found] == whole.reference.tolist()
    if noise < 100:
        assert whole.reference[SETTINGS.length - 1 :].tolist() == list(range(5 + SETTINGS.length - 1, 30))


def test_the_place_is_in_the_right_demonstration_and_no_trajectory_spans_two() -> None:
    shown = {"a": traverse(30, 1), "b": traverse(20, 2), "c": traverse(25, 3)}
    localizer = SeqSlamLocalizer([shown[name] for name in ("c", "a", "b")], SETTINGS)
    for number, name in enumerate(("c", "a", "b")):
        localizer.reset()
        seen = traverse(len(shown[name]), {"a": 1, "b": 2, "c": 3}[name], 20.0, 5)
        found = [localizer.observe(image) for image in seen]
        assert found[: SETTINGS.length - 1] == [None] * (SETTINGS.length - 1)
        places = [place for place in found if place is not None]
        assert [place.demonstration for place in places] == [number] * len(places)
        assert [place.frame for place in places] == list(range(SETTINGS.length - 1, len(seen)))
        shortest = SETTINGS.trajectories()[0][-1]
        assert all(place.frame >= shortest for place in places)
    # The end of one demonstration followed by the start of the next is no place.
    localizer.reset()
    for image in [*shown["c"][-3:], *shown["a"][:3]]:
        place = localizer.observe(image)
    assert place is not None
    assert (place.demonstration, place.frame) != (1, 2)


def test_it_does_what_was_done_where_it_finds_itself() -> None:
    images = [picture(place) for place in range(32)]
    atoms = np.full(32, Atom.FORWARD, dtype=np.int8)
    atoms[12:16], atoms[-1] = Atom.LEFT, Atom.STOP
    taught = Demonstration("d", np.zeros((32, 1), np.float32), atoms, images=images)
    robot = SeqSlamImitation([taught], SeqSlamSettings(length=4))
    done = [robot.step(image) for image in images]
    assert done[3:] == atoms[3:].tolist()
    assert Atom.STOP not in done[:3], "it moves at once, though it is not sure yet"
    with pytest.raises(ValueError, match="no demonstration is long enough"):
        SeqSlamLocalizer([traverse(3, 1)], SETTINGS)
