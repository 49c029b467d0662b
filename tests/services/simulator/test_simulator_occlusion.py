"""What is called hidden lies behind walls, by rays to points in it; and what plainly is hidden is called so."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from shapely import Polygon, affinity

from services.simulator.scene.occlusion import Occluders, View, looking
from services.simulator.scene.shapes import outline
from services.simulator.scene.surfaces import Block

EYE = np.array([0.0, 0.0, 1.2])
TANGENTS = (0.77, 0.58)


def block(footprint: Polygon, height_m: float) -> Block:
    return Block(outline(footprint)[0], height_m)


def towards(azimuth: float, eye: NDArray[np.float64] = EYE, pitch: float = 0.0) -> View:
    cos, sin = math.cos(azimuth), math.sin(azimuth)
    ahead = np.array([cos * math.cos(pitch), sin * math.cos(pitch), math.sin(pitch)])
    left = np.array([-sin, cos, 0.0])
    return looking(eye, np.stack([ahead, left, np.cross(ahead, left)]), TANGENTS)


def box(west: float, south: float, east: float, north: float, top: float) -> NDArray[np.float64]:
    return np.array([[(west, south, 0.0), (east, north, top)]])


def is_free(eye: NDArray[np.float64], point: NDArray[np.float64], blocks: list[tuple[Polygon, float]]) -> bool:
    """Return whether a straight line reaches a point without going through a block below its top."""
    ray = shapely.LineString([eye[:2], point[:2]])
    for footprint, height_m in blocks:
        crossed = shapely.get_coordinates(ray.intersection(footprint))
        if len(crossed):
            entered_m = float(np.linalg.norm(crossed - eye[:2], axis=1).min())
            if eye[2] + (point[2] - eye[2]) * entered_m / ray.length <= height_m:
                return False
    return True


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 10**6), st.floats(-math.pi, math.pi), st.floats(-0.3, 0.3))
def test_no_ray_reaches_what_is_called_hidden(seed: int, azimuth: float, pitch: float) -> None:
    rng = np.random.default_rng(seed)
    blocks = []
    for _ in range(25):
        west, south, height = rng.uniform(-80, 80), rng.uniform(-80, 80), rng.uniform(2, 20)
        bent = shapely.box(west, south, west + 20, south + 8).union(shapely.box(west, south, west + 6, south + 18))
        blocks.append((affinity.rotate(bent, float(rng.uniform(0, 360))), float(height)))
    low = rng.uniform(-200, 200, (60, 3)) * (1, 1, 0)
    boxes = np.stack([low, low + rng.uniform(1, 30, (60, 3)) * (1, 1, 0.6)], axis=1)
    view = towards(azimuth, pitch=pitch)
    hidden = Occluders([block(*one) for one in blocks]).hidden(view, boxes)
    for lowest, highest in boxes[hidden]:
        for point in rng.uniform(lowest, highest, (12, 3)):
            if abs(view.off(point[:2] - EYE[:2])) <= view.half:
                assert not is_free(EYE, point, blocks)


def test_a_box_behind_a_wall_is_hidden_and_a_taller_or_nearer_or_wider_one_is_not() -> None:
    wall = Occluders([block(shapely.box(20, -30, 22, 30), 8.0)])
    behind, taller = box(60, -10, 80, 10, 20.0), box(60, -10, 80, 10, 30.0)
    before, wider = box(5, -2, 15, 2, 1.0), box(60, 10, 90, 120, 5.0)
    found = wall.hidden(towards(0.5), np.concatenate([behind, taller, before, wider]))
    np.testing.assert_array_equal(found, [True, False, False, False])
    # Further to the right, what sticks out beyond the left end of the wall is out of view.
    assert wall.hidden(towards(0.0), wider)[0]


@pytest.mark.parametrize("turn", [0.0, 1.0, math.pi, -2.5])
def test_what_is_hidden_does_not_depend_on_where_north_is(turn: float) -> None:
    cos, sin = math.cos(turn), math.sin(turn)
    wall = Occluders([block(affinity.rotate(shapely.box(20, -30, 22, 30), turn, (0, 0), use_radians=True), 8.0)])
    x, y = 70 * cos, 70 * sin
    assert wall.hidden(towards(turn), box(x - 3, y - 3, x + 3, y + 3, 10.0))[0]
    assert not wall.hidden(towards(turn), box(x - 3, y - 3, x + 3, y + 3, 30.0))[0]


def test_a_gap_between_two_walls_lets_one_see_through() -> None:
    far = box(100, -8, 110, 8, 6.0)
    for begins, is_hidden in ((-0.5, True), (1.0, False)):
        walls = [block(shapely.box(20, -30, 22, 0), 8.0), block(shapely.box(20, begins, 22, 30), 8.0)]
        assert bool(Occluders(walls).hidden(towards(0.0), far)[0]) is is_hidden


def test_walls_are_seen_through_from_inside_and_from_too_near() -> None:
    far = box(60, -5, 70, 5, 5.0)
    for footprint in (shapely.box(-30, -30, 30, 30), shapely.box(0.3, -30, 30, 30)):
        assert not Occluders([block(footprint, 20.0)]).hidden(towards(0.0), far)[0]
    assert Occluders([block(shapely.box(0.8, -30, 30, 30), 20.0)]).hidden(towards(0.0), far)[0]


def test_nothing_is_hidden_without_blocks_or_looking_down() -> None:
    far = box(60, -5, 70, 5, 5.0)
    assert not Occluders([]).hidden(towards(0.0), far)[0]
    wall = Occluders([block(shapely.box(20, -30, 22, 30), 8.0)])
    assert not wall.hidden(towards(0.0, pitch=-1.5), far)[0]
    assert wall.hidden(towards(0.0), np.empty((0, 2, 3))).shape == (0,)
