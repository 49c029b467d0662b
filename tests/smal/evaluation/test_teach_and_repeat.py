"""Teach and repeat returns to the taught way, tells headings from shifts, and stops at the end."""

import math
from dataclasses import replace

import numpy as np
import pytest

from smal.evaluation.teach_and_repeat import TeachAndRepeat
from tests.smal.evaluation.wood import FIELD_RAD, TAUGHT, Wood


@pytest.mark.parametrize(
    "start", [(0.0, 0.0, 0.0), (0.0, 0.6, 0.2), (0.0, -0.6, 0.25), (0.3, 0.6, -0.3)]
)
def test_repeat_returns_to_the_taught_way_and_stops_at_its_end(
    start: tuple[float, float, float],
) -> None:
    wood = Wood(1)
    poses = wood.repeat(TeachAndRepeat([wood.drive], FIELD_RAD), start, 300)
    aside = wood.aside(poses)
    assert len(poses) < 200, "it stops"
    assert math.dist(poses[-1, :2], wood.way[-1, :2]) < 2.0, "within the reach of a goal"
    assert aside[-20:].max() < max(0.5 * aside[0], 0.2)


def test_repeat_starts_anywhere_and_looks_round_when_reversed() -> None:
    wood = Wood(1)
    robot = TeachAndRepeat([wood.drive], FIELD_RAD)
    assert wood.aside(wood.repeat(robot, tuple(wood.way[45]), 300)).max() < 0.3
    backwards = (*wood.way[20, :2], math.pi)
    poses = wood.repeat(robot, backwards, 300)
    assert np.ptp(poses[:90, 2]) > 0.9 * math.tau
    assert math.dist(poses[-1, :2], wood.way[-1, :2]) < 2.0


def test_unusable_demonstration_is_refused_in_one_line() -> None:
    drive = Wood(1).drive
    with pytest.raises(
        ValueError, match="demonstration d: teach and repeat needs images and odometry"
    ):
        TeachAndRepeat([replace(drive, odometry=None)], FIELD_RAD)
    with pytest.raises(ValueError, match="at least one turn"):
        TeachAndRepeat([replace(drive, odometry=np.zeros((len(TAUGHT), 3)))], FIELD_RAD)
