"""The true age of a depth image, whatever its stamp."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from smal.obstacles.capture_time import LONGEST_S, CaptureTime
from tests.smal.depth_world import MOUNT, Box, depth

Pose = tuple[float, float, float]
TICK_S = 0.1
#: A yard with things near and far, none of them in the way.
YARD: list[Box] = [
    (9.0, -6.0, 9.4, 6.0, 2.0), (4.0, 1.5, 4.6, 2.5, 1.2), (6.0, -3.0, 7.0, -1.8, 2.5), (3.0, -3.5, 3.4, -2.0, 0.8),
]  # fmt: skip


def straight(tick: int) -> Pose:
    """Stand for half a second, then speed up to 2 m/s."""
    moving_s = max(tick - 5, 0) * TICK_S
    return (2.0 * moving_s**2 if moving_s < 0.5 else 0.5 + 2.0 * (moving_s - 0.5)), 0.0, 0.0


def turning(tick: int) -> Pose:
    return 0.0, 0.0, math.radians(45.0) * max(tick - 5, 0) * TICK_S


def delays(
    way: Callable[[int], Pose],
    shown: Callable[[int], int],
    ticks: int,
    seed: int = 0,
    noise: float = 0.01,
) -> list[float]:
    """Deliver, tick after tick, the image of another tick; return how old each is said to be."""
    rng = np.random.default_rng(seed)
    made = CaptureTime(MOUNT)
    images = {}
    found = []
    for tick in range(ticks):
        if shown(tick) not in images:
            factors = rng.normal(1.0, noise, (60, 80))
            images[shown(tick)] = (depth(YARD, way(shown(tick))) * factors).astype(np.float32)
        made.note(way(tick), tick * TICK_S)
        at_s, pose = made.estimate(images[shown(tick)])
        found.append(tick * TICK_S - at_s)
        assert pose == pytest.approx(way(round(at_s / TICK_S)))
    return found


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("way", [straight, turning])
def test_delay_is_zero_when_images_are_on_time(way: Callable[[int], Pose], seed: int) -> None:
    assert max(delays(way, lambda tick: tick, 35, seed)) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("way", [straight, turning])
@pytest.mark.parametrize("frozen_at", [0, 15])
def test_delay_grows_when_the_camera_is_frozen(way: Callable[[int], Pose], frozen_at: int) -> None:
    found = delays(way, lambda tick: min(tick, frozen_at), 35)
    moves_at = max(frozen_at, 6)  # A robot that stands sees the same.
    assert found[moves_at + 4] > 0.25
    assert found[-1] > 0.8 * LONGEST_S


@pytest.mark.parametrize("way", [straight, turning])
def test_delay_is_found_when_images_are_late(way: Callable[[int], Pose]) -> None:
    found = delays(way, lambda tick: max(tick - 5, 0), 35)
    # It moves 0.6 s before; of a late image it is known from then on.
    assert min(found[12:]) == pytest.approx(0.5, abs=0.11)


@pytest.mark.parametrize("noise", [0.01, 0.0])  # A simulator repeats the image of a standing robot.
def test_delay_stays_when_a_late_robot_stands_again(noise: float) -> None:
    def stops(tick: int) -> Pose:
        return straight(min(tick, 20))

    found = delays(stops, lambda tick: max(tick - 5, 0), 120, noise=noise)
    assert min(found[12:40]) > 0.25
    assert found[-1] < 0.25  # A robot that was called late by mistake does not stand for ever.


@pytest.mark.parametrize("way", [straight, turning])
@pytest.mark.parametrize(
    "to", [(0.0, 3.0, 1.0), (-2.0, -1.0, math.pi), (4.0, -1.0, -0.5), (-2.0, 0.5, 0.1)]
)
def test_delay_is_zero_when_the_robot_was_carried(way: Callable[[int], Pose], to: Pose) -> None:
    rng = np.random.default_rng(0)
    made = CaptureTime(MOUNT)
    for tick in range(40):
        x, y, heading = way(tick)
        there = (x, y, heading) if tick < 20 else (x + to[0], y + to[1], heading + to[2])
        made.note((x, y, heading), tick * TICK_S)
        at_s, _ = made.estimate(
            (depth(YARD, there) * rng.normal(1.0, 0.01, (60, 80))).astype(np.float32)
        )
        assert tick * TICK_S - at_s < 0.25


#: Smooth walls on both sides: an image says little of how far along the robot is.
STREET: list[Box] = [
    (-5.0, 2.5, 60.0, 3.0, 3.0),
    (-5.0, -4.0, 60.0, -3.5, 3.0),
    (20.0, 1.5, 20.5, 2.5, 2.0),
]


@pytest.mark.parametrize("seed", range(3))
def test_delay_is_zero_when_the_camera_shakes(seed: int) -> None:
    """A mast swings by 1.4 degrees while the robot drives; images are on time, in the yard and in a street."""
    for boxes in (YARD, STREET):
        rng = np.random.default_rng(seed)
        made = CaptureTime(MOUNT)
        for tick in range(60):
            x, y, heading = straight(tick)
            yaw, pitch = np.radians(rng.uniform(-0.7, 0.7, 2))
            shown = depth(boxes, (x, y, heading + yaw), pitch) * rng.normal(1.0, 0.02, (60, 80))
            made.note((x, y, heading), tick * TICK_S)
            at_s, _ = made.estimate(shown.astype(np.float32))
            assert tick * TICK_S - at_s < 0.25


@pytest.mark.parametrize("hang_s", [0.3, 0.5, 1.0, 2.0])
def test_delay_ends_after_a_hang_of_any_length(hang_s: float) -> None:
    until = 12 + round(hang_s / TICK_S)

    def stands_meanwhile(tick: int) -> Pose:
        return straight(tick if tick < 14 else max(14, tick - (until - 14)))

    found = delays(stands_meanwhile, lambda tick: 12 if 12 <= tick < until else tick, until + 20)
    assert max(found[until + 3 :]) < 0.25
