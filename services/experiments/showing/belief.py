"""What recognition believes on the drives that it was taught from: they are driven again, frame by frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.experiments.showing.ways import Ways
from smal.demonstration import Demonstration
from smal.model import Model
from smal.movement import placed
from smal.robot import Localizer


@dataclass(frozen=True, eq=False)
class Believed:
    """Of each frame of a drive, where the belief was.

    Parameters
    ----------
    here : float64 array (f,)
        Probability of being within a correlation length of where the robot was.
    lost : float64 array (f,)
        Of being nowhere near what was taught. What is left of 1 lay elsewhere on the taught ways.
    spread : float64 array (f,)
        Standard deviation of the place, given that the robot is on this drive or one that is joined to it.
    """

    here: NDArray[np.float64]
    lost: NDArray[np.float64]
    spread: NDArray[np.float64]

    def wide(self) -> list[tuple[int, int]]:
        """Return first and last frame of each stretch on which the robot was less likely here than not."""
        edges = np.diff((self.here < 0.5).astype(int), prepend=0, append=0)
        return list(zip(np.flatnonzero(edges > 0).tolist(), (np.flatnonzero(edges < 0) - 1).tolist(), strict=True))


def believed(model: Model, ways: Ways, drive: int, one: Demonstration, advance: Callable[[int], object]) -> Believed:
    """Let recognition follow a taught drive from its beginning.

    Parameters
    ----------
    model, ways
    drive
        Of the map.
    one
        It, whole.
    advance
        Called with 1 after each frame.
    """
    localizer = Localizer(model)
    first = int(np.searchsorted(ways.map.drives, drive))
    group_of, key_poses = ways.groups[ways.of], ways.key_poses
    here, lost, spread = [], [], []
    for k, features in enumerate(one.features):
        pose = None if one.odometry is None else one.odometry[k].tolist()
        belief = localizer.observe(features, pose, [one.atoms[k - 1]] if k else [])
        at = placed(belief.offsets, key_poses[belief.keyframes])[:, :2]
        weights = belief.weights * (group_of[belief.keyframes] == ways.groups[drive])
        near = np.hypot(*(at - ways.poses[first + k, :2]).T) < ways.map.correlation_length
        here.append((1.0 - belief.lost) * float(weights @ near))
        lost.append(belief.lost)
        weights /= max(float(weights.sum()), 1e-12)
        spread.append(float(np.sqrt(weights @ np.square(at - weights @ at).sum(axis=1))))
        advance(1)
    return Believed(np.array(here), np.array(lost), np.array(spread))
