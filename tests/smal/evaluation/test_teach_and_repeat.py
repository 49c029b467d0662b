"""Teach and repeat returns to the taught way, tells headings from shifts, and stops at the end."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from smal.evaluation.teach_and_repeat import COLUMNS, TeachAndRepeat
from smal.movement import Atom
from smal.teaching.demonstration import Demonstration

HEIGHT = 44
WIDTH = COLUMNS
FIELD_RAD = math.radians(75.0)
STEP_M = 0.2
TURN_RAD = math.radians(4.0)
#: A straight way of 8 m, a bend of 48 degrees to the left, 6 m.
TAUGHT = [Atom.FORWARD] * 40 + [Atom.LEFT, Atom.FORWARD] * 12 + [Atom.FORWARD] * 30 + [Atom.STOP]


class Wood:
    """Grey pillars at random places around the taught way, and a robot in it that does what atoms say."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        at = rng.uniform((-10, -15), (35, 25), (500, 2))
        self.way = np.array([(0.0, 0.0, 0.0)])
        for atom in TAUGHT[:-1]:
            self.way = np.vstack([self.way, moved(self.way[-1], atom)])
        gap = np.hypot(*np.moveaxis(at[:, None] - self.way[None, :, :2], 2, 0)).min(axis=1)
        self.pillars = np.column_stack(
            [at, rng.uniform(0.1, 0.4, len(at)), rng.uniform(0, 255, len(at))]
        )[gap > 1.5]

    def seen(self, pose: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Paint the pillars, far ones first; columns are equal angles."""
        image = np.full((HEIGHT, WIDTH), 128, dtype=np.uint8)
        x, y = (self.pillars[:, :2] - pose[:2]).T
        distance = np.hypot(x, y)
        bearing = (np.arctan2(y, x) - pose[2] + np.pi) % (2 * np.pi) - np.pi
        middle = WIDTH * (0.5 - bearing / FIELD_RAD)
        half = WIDTH / FIELD_RAD * self.pillars[:, 2] / distance
        left, right = np.clip([middle - half, middle + half], 0, WIDTH).round().astype(int)
        rows = np.minimum(HEIGHT / distance, HEIGHT / 2).astype(int)
        for one in np.argsort(-distance):
            top = HEIGHT // 2 - rows[one]
            bottom = HEIGHT // 2 + rows[one]
            image[top:bottom, left[one] : right[one]] = self.pillars[one, 3]
        return image[..., None].repeat(3, axis=2)

    def drive(self) -> Demonstration:
        images = [self.seen(pose) for pose in self.way]
        atoms = np.array(TAUGHT, dtype=np.int8)
        return Demonstration(
            "d", np.zeros((len(atoms), 1), np.float32), atoms, images=images, odometry=self.way
        )

    def repeat(
        self, robot: TeachAndRepeat, start: tuple[float, ...], ticks: int, slip: float = 0.0
    ) -> NDArray[np.float64]:
        """Return the poses (f, 3) until it stops; wheels that slip count more way than there is."""
        poses = [np.array(start)]
        wheels = np.zeros(3)
        robot.reset()
        while (
            len(poses) < ticks
            and (atom := robot.step(self.seen(poses[-1]), wheels.tolist())) != Atom.STOP
        ):
            poses.append(moved(poses[-1], atom))
            step = moved(wheels, atom) - wheels
            wheels = wheels + step * [1.0 + slip, 1.0 + slip, 1.0]
        return np.array(poses)


def moved(pose: NDArray[np.float64], atom: Atom) -> NDArray[np.float64]:
    ahead = STEP_M * (atom == Atom.FORWARD)
    turn = TURN_RAD * ((atom == Atom.LEFT) - float(atom == Atom.RIGHT))
    there: NDArray[np.float64] = pose + np.array(
        [ahead * math.cos(pose[2]), ahead * math.sin(pose[2]), turn]
    )
    return there


def aside_of(way: NDArray[np.float64], poses: NDArray[np.float64]) -> NDArray[np.float64]:
    nearest: NDArray[np.float64] = np.hypot(
        *np.moveaxis(poses[:, None, :2] - way[None, :, :2], 2, 0)
    ).min(axis=1)
    return nearest


@pytest.mark.parametrize(
    "start", [(0.0, 0.0, 0.0), (0.0, 0.6, 0.2), (0.0, -0.6, 0.25), (0.3, 0.6, -0.3)]
)
def test_repeat_returns_to_the_taught_way_and_stops_at_its_end(
    start: tuple[float, float, float],
) -> None:
    wood = Wood(1)
    poses = wood.repeat(TeachAndRepeat([wood.drive()], FIELD_RAD), start, 300)
    aside = aside_of(wood.way, poses)
    assert len(poses) < 200, "it stops"
    assert math.dist(poses[-1, :2], wood.way[-1, :2]) < 2.0, "within the reach of a goal"
    assert aside[-20:].max() < max(0.5 * aside[0], 0.2)


def test_repeat_starts_anywhere_and_looks_round_when_reversed() -> None:
    wood = Wood(1)
    robot = TeachAndRepeat([wood.drive()], FIELD_RAD)
    assert aside_of(wood.way, wood.repeat(robot, tuple(wood.way[45]), 300)).max() < 0.3
    backwards = (*wood.way[20, :2], math.pi)
    poses = wood.repeat(robot, backwards, 300)
    assert np.ptp(poses[:90, 2]) > 0.9 * math.tau
    assert math.dist(poses[-1, :2], wood.way[-1, :2]) < 2.0


def test_unusable_demonstration_is_refused_in_one_line() -> None:
    drive = Wood(1).drive()
    with pytest.raises(
        ValueError, match="demonstration d: teach and repeat needs images and odometry"
    ):
        TeachAndRepeat([replace(drive, odometry=None)], FIELD_RAD)
    with pytest.raises(ValueError, match="at least one turn"):
        TeachAndRepeat([replace(drive, odometry=np.zeros((len(TAUGHT), 3)))], FIELD_RAD)
