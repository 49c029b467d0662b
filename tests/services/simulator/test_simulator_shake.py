"""Camera shake: as strong as set, none at rest, the same however it is stepped; blur along the way the picture goes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from services.simulator.camera import blur
from services.simulator.robots import TURTLEBOT
from services.simulator.sensors import Shake, ShakeSettings, Step, TiltRate
from services.simulator.world.place import Pose

DRIVE = TURTLEBOT.drive
STEP_S = 0.02


def step(speed: float, turning: float = 0.0, duration_s: float = STEP_S) -> Step:
    """Return a step at fractions of the nominal speed and turn rate."""
    after = Pose(speed * DRIVE.speed_m_s * duration_s, 0.0, turning * DRIVE.turn_rate_rad_s * duration_s)
    return Step(Pose(0.0, 0.0, 0.0), after, (0.0, 0.0), duration_s)


def swings(steps: list[Step], seed: int = 0, settings: ShakeSettings | None = None) -> NDArray[np.float64]:
    """Return the tilts and their rates (n, 2, 3) after each step."""
    shake = Shake(settings or ShakeSettings(), DRIVE, np.random.default_rng(seed))
    found = []
    for one in steps:
        shake.step(one)
        found.append((shake.tilt, shake.rate))
    return np.array(found)


LONG = swings([step(1.0)] * 60_000)


def test_at_the_nominal_speed_each_angle_varies_as_set() -> None:
    """Samples are correlated over 0.1 s: 1200 s are about 12,000 independent ones, so 1 % is 1.5 sigma."""
    np.testing.assert_allclose(np.degrees(LONG[100:, 0].std(axis=0)), [1.0, 1.0, 0.5], rtol=0.04)
    np.testing.assert_allclose(LONG[100:, 0].mean(axis=0), 0, atol=math.radians(0.04))


@given(strength=st.floats(0, 10), seed=st.integers(0, 1000), moves=st.lists(st.floats(-1, 1), max_size=20))
@settings(max_examples=50, deadline=None)
def test_strength_is_one_factor_and_a_seed_repeats(strength: float, seed: int, moves: list[float]) -> None:
    steps = [step(move) for move in moves]
    plain = swings(steps, seed)
    np.testing.assert_allclose(swings(steps, seed, ShakeSettings(strength)), strength * plain, atol=1e-12)
    np.testing.assert_array_equal(swings(steps, seed), plain)


# -- blur -------------------------------------------------------------------------------------------------------------

FOCAL_PX, EXPOSURE_S = 200.0, 0.02


def dot() -> NDArray[np.uint8]:
    """Return a bright square, 5 wide, on black, in the middle of 121x161."""
    image = np.zeros((121, 161, 3), dtype=np.uint8)
    image[58:63, 78:83] = 250
    return image


def spread(image: NDArray[np.uint8]) -> tuple[float, float, float, float, float]:
    """Return mean column and row, and the variances and covariance of columns and rows, weighted by brightness."""
    weight = image.sum(axis=2) / image.sum()
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]]
    x, y = float((weight * columns).sum()), float((weight * rows).sum())
    dx, dy = columns - x, rows - y
    return x, y, float((weight * dx**2).sum()), float((weight * dy**2).sum()), float((weight * dx * dy).sum())


@given(yaw=st.floats(-6, 6), pitch=st.floats(-6, 6))
@settings(max_examples=40, deadline=None)
def test_a_point_becomes_a_line_as_long_as_its_way(yaw: float, pitch: float) -> None:
    """A way of (a, b) pixels, gone evenly, adds the covariance of (a, b) outer (a, b) / 12."""
    a, b = FOCAL_PX * yaw * EXPOSURE_S, -FOCAL_PX * pitch * EXPOSURE_S
    image = dot()
    blurred = blur(image, TiltRate(0.0, pitch, yaw), EXPOSURE_S, FOCAL_PX)
    assert int(blurred.sum()) == pytest.approx(int(image.sum()), rel=0.03), "light is neither made nor lost"
    (x, y, xx, yy, xy), (x0, y0, xx0, yy0, _) = spread(blurred), spread(image)
    assert (x, y) == (pytest.approx(x0, abs=0.2), pytest.approx(y0, abs=0.2))
    tolerance = 1.0 + 0.05 * (a**2 + b**2) / 12
    assert xx - xx0 == pytest.approx(a**2 / 12, abs=tolerance)
    assert yy - yy0 == pytest.approx(b**2 / 12, abs=tolerance)
    assert xy == pytest.approx(a * b / 12, abs=tolerance)
