"""The place filter follows a drive, finds its place again, and equals filtering by its definition."""

import math
from dataclasses import replace

import numpy as np
import pytest

from smal.evaluation.place_filter import DELTA, OFFSETS, FrameFilter, PlaceFilter
from tests.smal.evaluation.wood import FEATURES, FIELD_RAD, Wood
from tests.smal.worlds import corridor, unit


@pytest.fixture(scope="module")
def wood() -> Wood:
    return Wood(1)


@pytest.fixture(scope="module")
def robot(wood: Wood) -> PlaceFilter:
    return PlaceFilter([wood.drive], FEATURES, FIELD_RAD)


def test_frame_filter_equals_the_sum_over_all_ways() -> None:
    lengths = (5, 4)
    places = corridor(sum(lengths), size=8, smooth=0.8).astype(np.float32)
    rng = np.random.default_rng(1)
    views = unit(places[[1, 2, 2, 4]] + 0.4 * unit(rng.standard_normal((4, 8)))).astype(np.float32)
    filtered = FrameFilter(places, lengths)
    for view in views:
        belief = filtered.observe(view)
    away = np.array([[np.linalg.norm(place - view) for place in places] for view in views])
    near, far = np.quantile(away[0], (0.025, 0.975))
    likely = DELTA ** (-away / (far - near))
    expected = np.zeros(len(places))
    for begin in range(len(places)):
        first, last = (0, 4) if begin < 5 else (5, 8)
        ways = {(begin,): likely[0, begin]}
        for weights in likely[1:]:
            ways_on: dict[tuple[int, ...], float] = {}
            for way, weight in ways.items():
                for offset in OFFSETS:
                    end = min(max(way[-1] + offset, first), last)
                    longer = (*way, end)
                    ways_on[longer] = ways_on.get(longer, 0.0) + weight * weights[end]
            ways = ways_on
        for way, weight in ways.items():
            expected[way[-1]] += weight
    np.testing.assert_allclose(belief, expected / expected.sum(), atol=1e-5)


@pytest.mark.parametrize("start", [(0.0, 0.0, 0.0), (0.0, 0.5, 0.1), (0.3, -0.4, -0.1)])
def test_place_filter_follows_the_way_and_announces_its_end(
    wood: Wood, robot: PlaceFilter, start: tuple[float, float, float]
) -> None:
    poses = wood.repeat(robot, start, 300)
    assert robot.said == "found"
    assert math.dist(poses[-1, :2], wood.way[-1, :2]) < 2.0
    assert wood.aside(poses)[-20:].max() < max(abs(start[1]), 0.3)


def test_place_filter_finds_its_place_again_when_carried(wood: Wood, robot: PlaceFilter) -> None:
    poses = wood.repeat(robot, tuple(wood.way[0]), 300, carried={15: tuple(wood.way[70])})
    assert robot.said == "found"
    assert len(poses) < 15 + 60, "it goes on from there"
    assert math.dist(poses[-1, :2], wood.way[-1, :2]) < 2.0


def test_place_filter_looks_round_when_turned(wood: Wood, robot: PlaceFilter) -> None:
    poses = wood.repeat(robot, (*wood.way[20, :2], math.pi), 400)
    assert np.ptp(poses[:100, 2]) > 0.4 * math.tau
    assert robot.said == "found"
    assert math.dist(poses[-1, :2], wood.way[-1, :2]) < 2.0


def test_place_filter_names_a_drive_without_odometry(wood: Wood) -> None:
    with pytest.raises(ValueError, match="demonstration d: a place filter needs images and odom"):
        PlaceFilter([replace(wood.drive, odometry=None)], FEATURES, FIELD_RAD)
