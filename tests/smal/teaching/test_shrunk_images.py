"""Images of large cameras: features and maps are those of the shrunk images."""

from collections.abc import Sequence
from functools import cache
from typing import Any

import cv2
import numpy as np
import pytest

from smal.features import FeatureSettings
from smal.features.extraction import looked_at
from smal.features.percept import perceive
from smal.map import VisualMap
from smal.teaching.mapping import fit
from tests.smal.synthetic_world import COLOR, Room, drive

USUAL = FeatureSettings()
ROOM = Room()


def enlarged(image: np.ndarray, columns: int, rows: int) -> np.ndarray:
    return cv2.resize(image, (columns, rows), interpolation=cv2.INTER_CUBIC)


@cache
def drive_at(columns: int, rows: int) -> list[np.ndarray]:
    return [enlarged(ROOM.look(pose), columns, rows) for pose in drive().poses]


def taught(images: Sequence[Any]) -> VisualMap:
    one = drive()
    return fit([(images, one.atoms, one.poses)], COLOR).mapped


@pytest.mark.parametrize("size", [(1024, 768), (1280, 720), (641, 487), (64, 48)])
def test_percept_is_equal_when_the_image_is_shrunk_before(size: tuple[int, int]) -> None:
    image = enlarged(ROOM.look(drive().poses[9]), *size)
    seen = looked_at(image, USUAL)
    expected = perceive(image, USUAL)
    found = perceive(seen, USUAL)
    np.testing.assert_array_equal(found.features, expected.features)
    np.testing.assert_array_equal(found.picture, expected.picture)
    assert seen.shape[0] <= 240 or seen.shape[1] <= 320


@pytest.mark.parametrize("size", [(640, 480), pytest.param((640, 360), marks=pytest.mark.long)])
def test_map_is_equal_when_the_images_are_shrunk_before(size: tuple[int, int]) -> None:
    large = drive_at(*size)
    expected = taught([looked_at(image, COLOR) for image in large])
    found = taught(large)
    np.testing.assert_array_equal(found.views, expected.views)
    assert found.taught_scene == expected.taught_scene
    assert found.size == size


def test_virtual_views_are_small_when_the_camera_is_large(monkeypatch: pytest.MonkeyPatch) -> None:
    pixels = []
    remap = cv2.remap

    def counted(image: np.ndarray, *rest: Any, **options: Any) -> np.ndarray:
        view = remap(image, *rest, **options)
        pixels.append(view.shape[0] * view.shape[1])
        return view

    large = drive_at(640, 480)
    monkeypatch.setattr(cv2, "remap", counted)
    taught(large)
    assert max(pixels) == 120 * 160
