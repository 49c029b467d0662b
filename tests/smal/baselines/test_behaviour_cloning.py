"""Behaviour cloning learns a rule that can be seen, the same way every time, and says what it lacks."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from numpy.typing import NDArray

from smal.action_space import Atom
from smal.evaluation.baselines.behaviour_cloning import CloningSettings, CloningUnavailableError, clone, load_torch
from smal.evaluation.baselines.thumbnails import COLUMNS, ROWS, thumbnail


def lamp(side: int, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return a noisy picture with a lamp on the left (-1), on the right (1) or in the middle (0)."""
    image = rng.integers(0, 90, (ROWS, COLUMNS, 3), dtype=np.uint8)
    column, row = 32 + 20 * side + int(rng.integers(-5, 6)), int(rng.integers(10, 38))
    image[row - 4 : row + 4, column - 4 : column + 4] = 230
    return image


def drives(count: int, seed: int) -> tuple[list[NDArray[np.uint8]], list[NDArray[np.int8]]]:
    """Return drives of somebody who turns to the lamp; mostly it is ahead."""
    rng = np.random.default_rng(seed)
    keys = {-1: Atom.LEFT, 0: Atom.FORWARD, 1: Atom.RIGHT}
    sides = [rng.choice([-1, 0, 1], 60, p=[0.15, 0.7, 0.15]) for _ in range(count)]
    images = [np.stack([lamp(int(side), rng) for side in each]) for each in sides]
    return images, [np.array([keys[int(side)] for side in each], dtype=np.int8) for each in sides]


def test_it_learns_to_turn_to_a_lamp_and_does_so_again_with_the_same_seed() -> None:
    pytest.importorskip("torch")
    settings = CloningSettings(epochs=8, seed=3)
    images, atoms = drives(8, 1)
    cloned = clone(images, atoms, settings)
    unseen, wanted = drives(3, 2)
    done = [cloned.act(image) for image in np.concatenate(unseen)]
    right = np.mean([one == want for one, want in zip(done, np.concatenate(wanted), strict=True)])
    assert right > 0.9
    again = clone(images, atoms, settings)
    np.testing.assert_array_equal(again.scores(unseen[0]), cloned.scores(unseen[0]))
    other = clone(images, atoms, CloningSettings(epochs=1, seed=4))
    assert not np.array_equal(other.scores(unseen[0]), cloned.scores(unseen[0]))


def test_it_stops_when_there_is_nothing_more_to_learn() -> None:
    pytest.importorskip("torch")
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 255, (20, ROWS, COLUMNS, 3), dtype=np.uint8) for _ in range(4)]
    atoms = [rng.integers(1, 5, 20).astype(np.int8) for _ in range(4)]
    losses: list[float] = []
    settings = CloningSettings(epochs=60, patience=3)
    clone(images, atoms, settings, lambda _epoch, loss: losses.append(loss))
    assert len(losses) < 60, "keys by chance cannot be told from images"
    assert losses.index(min(losses)) + 1 == len(losses) - settings.patience


def test_without_torch_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(CloningUnavailableError, match=r"needs torch.*pip install -e '.\[cloning\]'"):
        load_torch()
    with pytest.raises(CloningUnavailableError):
        clone(*drives(2, 1))


def test_demonstrations_that_do_not_fit_are_named() -> None:
    images, atoms = drives(2, 1)
    with pytest.raises(ValueError, match="at least two demonstrations"):
        clone(images[:1], atoms[:1])
    with pytest.raises(ValueError, match=r"demonstration 1: .*\(60, 48, 64, 3\) and \(59,\)"):
        clone(images, [atoms[0], atoms[1][1:]])
    with pytest.raises(ValueError, match="validation"):
        CloningSettings(validation=1.0)


def test_a_thumbnail_keeps_the_colours_of_its_image() -> None:
    image = np.zeros((240, 320, 3), dtype=np.uint8)
    image[:120] = (200, 100, 50)
    small = thumbnail(image)
    assert small.shape == (ROWS, COLUMNS, 3)
    np.testing.assert_array_equal(small[0, 0], (200, 100, 50))
    np.testing.assert_array_equal(small[-1, 0], 0)
