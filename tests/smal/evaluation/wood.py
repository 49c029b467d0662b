"""A wood of grey pillars, a way through it, and drivers that repeat the way."""

import math
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from smal.evaluation.driver import Driver
from smal.evaluation.image_shift import COLUMNS
from smal.features import FeatureSettings, extract
from smal.movement import MOTIONS, Atom, Motion
from smal.teaching.demonstration import Demonstration

HEIGHT = 44
WIDTH = COLUMNS
FIELD_RAD = math.radians(75.0)
STEP_M = 0.2
TURN_RAD = math.radians(4.0)
FEATURES: Final = FeatureSettings()
#: A straight way of 8 m, a bend of 48 degrees to the left, 6 m.
TAUGHT = [Atom.FORWARD] * 40 + [Atom.LEFT, Atom.FORWARD] * 12 + [Atom.FORWARD] * 30 + [Atom.STOP]


class Wood:
    """Grey pillars at random places around the taught way, and a robot in it that drives at velocities."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        at = rng.uniform((-10, -15), (35, 25), (500, 2))
        self.way = np.array([(0.0, 0.0, 0.0)])
        for atom in TAUGHT[:-1]:
            self.way = np.vstack([self.way, moved(self.way[-1], MOTIONS[atom])])
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

    @cached_property
    def drive(self) -> Demonstration:
        """The taught drive."""
        images = [self.seen(pose) for pose in self.way]
        features = np.stack([extract(image, FEATURES) for image in images])
        atoms = np.array(TAUGHT, dtype=np.int8)
        return Demonstration("d", features, atoms, images=images, odometry=self.way)

    def repeat(
        self,
        robot: Driver,
        start: tuple[float, ...],
        ticks: int,
        slip: float = 0.0,
        carried: dict[int, tuple[float, ...]] | None = None,
    ) -> NDArray[np.float64]:
        """Return the poses (f, 3) until it announces; wheels that slip count more way than there is."""
        poses = [np.array(start)]
        wheels = np.zeros(3)
        robot.reset(0)
        for tick in range(1, ticks):
            motion = robot.step(self.seen(poses[-1]), wheels.tolist(), None, 0.1)
            if robot.said is not None:
                break
            carry = (carried or {}).get(tick)
            poses.append(moved(poses[-1], motion) if carry is None else np.array(carry))
            step = moved(wheels, motion) - wheels
            wheels = wheels + step * [1.0 + slip, 1.0 + slip, 1.0]
        return np.array(poses)

    def aside(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the distances (f,) of poses from the taught way."""
        nearest: NDArray[np.float64] = np.hypot(
            *np.moveaxis(poses[:, None, :2] - self.way[None, :, :2], 2, 0)
        ).min(axis=1)
        return nearest


def moved(pose: NDArray[np.float64], motion: Motion) -> NDArray[np.float64]:
    """Return the pose after a tick."""
    ahead = STEP_M * motion[0]
    turn = TURN_RAD * motion[1]
    there: NDArray[np.float64] = pose + np.array(
        [ahead * math.cos(pose[2]), ahead * math.sin(pose[2]), turn]
    )
    return there
