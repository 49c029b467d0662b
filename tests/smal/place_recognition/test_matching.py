"""`smal.match`: images and features as arrays, or one after the other."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import smal
from smal.place_recognition.methods import FEATURES
from tests.smal.place_recognition.traverses import Walk

FRAMES = 30
WALL = cv2.resize(np.random.default_rng(3).integers(0, 256, (6, 90, 3), dtype=np.uint8), (1240, 72))


def images(share: float) -> NDArray[np.uint8]:
    """Return what a camera sees that passes a wall, so bright."""
    views = [WALL[:, 36 * place : 36 * place + 96] for place in range(FRAMES)]
    return (share * np.array(views)).astype(np.uint8)


def test_images_are_an_array_or_come_one_after_the_other() -> None:
    found = smal.match(images(1.0), (image for image in images(0.7)))
    assert (np.abs(found.reference - np.arange(FRAMES)) <= 1).all()
    again = smal.match(images(1.0), np.array([smal.extract(one, FEATURES) for one in images(0.7)]))
    np.testing.assert_allclose(found.score, again.score)


def test_features_are_of_any_kind() -> None:
    walk, places = Walk(np.random.default_rng(0), 200), np.arange(30.0, 180.0)
    references, queries = walk.at(np.arange(200.0), 0.4) + 3.0, walk.at(places, 1.0) - 2.0
    for method in ("smal", "nearest"):
        found = smal.match(references, queries, method=method)
        right = np.abs(found.reference - places)[found.matched] <= 6
        assert right.mean() > 0.8
    assert smal.match(references, queries + 5.0, tolerance=2, lag=3).score[20:].mean() > 0.8


def test_a_way_that_is_driven_twice_is_a_loop() -> None:
    walk = Walk(np.random.default_rng(0), 200)
    there = np.tile(np.arange(150.0), 2)
    found = smal.match(walk.at(there, 0.5), tolerance=2)
    assert found.score[:140].max() < 0.2
    assert found.score[160:].mean() > 0.9
    assert (np.abs(there[found.reference] - there)[160:] <= 2).mean() > 0.97


@pytest.mark.parametrize(
    ("arguments", "options", "said"),
    [
        ((np.zeros((3, 5)), np.zeros((3, 4))), {}, "shapes"),
        ((np.full((3, 5), np.nan), np.zeros((3, 5))), {}, "NaN"),
        ((np.zeros((2, 8, 8, 3), np.uint8),), {}, "at least 24 rows"),
        ((np.zeros((3, 5)),), {"method": "none"}, "unknown method 'none'; known are smal, nearest"),
        ((np.zeros((3, 5)),), {"method": "paper"}, "has no loops"),
        ((np.zeros((3, 5)), np.zeros((3, 5))), {"method": "seqslam"}, "has its own features"),
    ],
)
def test_what_cannot_be_matched_is_refused(arguments: tuple[object, ...], options: dict[str, str], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        smal.match(*arguments, **options)  # type: ignore[arg-type]
