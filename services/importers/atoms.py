"""Velocities become atom movements.

An atom is all or nothing: forward, backward, a turn, or a stop. How fast this robot usually drives and turns is
measured on the source itself, so that one rule does for a toy car's throttle and for metres a second. A tick that does
both is a turn where the turn is sharp, as one who has only keys would drive it, and keeps how fast it went ahead.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.base import ATOMS
from services.importers.drive import Array, ImportFailure

#: Slower than this nobody drives or turns on purpose: 2 cm and 6 degrees a second. Of a source without units it is 2 %
#: of full throttle, and 10 % of full lock at that.
_LEAST_LINEAR, _LEAST_ANGULAR = 0.02, 0.1
_FORWARD, _BACKWARD, _LEFT, _RIGHT, _STOP = (
    ATOMS.index(name) for name in ("forward", "backward", "left", "right", "stop")
)


@dataclass(frozen=True)
class Thresholds:
    """Where one atom ends and another begins.

    Parameters
    ----------
    quantile
        The nominal speed is that which so many of the moving ticks do not exceed, and so is the nominal turn rate: the
        fastest few are noise, or a hand that slipped.
    still
        Below this fraction of both nominal velocities the robot stands; joysticks have a dead zone of about as much.
    turning
        From this fraction of the nominal turn rate on a tick is a turn: the nearer of all and nothing.
    """

    quantile: float = 0.95
    still: float = 0.1
    turning: float = 0.5


@dataclass(frozen=True)
class Nominal:
    """How fast the robot usually drives and turns, in the source's units."""

    linear: float
    angular: float


def nominal(velocities: Array, thresholds: Thresholds) -> Nominal:
    """Measure it on the ticks of all drives.

    Parameters
    ----------
    velocities
        (2, n): linear and angular.
    thresholds
        Its quantile.

    Raises
    ------
    ImportFailure
        When the robot never moves.
    """
    linear, angular = np.abs(velocities)
    driving, turning = linear[linear > _LEAST_LINEAR], angular[angular > _LEAST_ANGULAR]
    if not driving.size:
        raise ImportFailure("the robot never drives: no velocity above 0.02; are its units metres a second?")
    fast = float(np.quantile(turning, thresholds.quantile)) if turning.size else _LEAST_ANGULAR
    return Nominal(float(np.quantile(driving, thresholds.quantile)), fast)


def atoms_of(velocities: Array, usual: Nominal, thresholds: Thresholds) -> NDArray[np.int8]:
    """Return the atom of each tick, (n,), its place in `ATOMS`."""
    linear, angular = velocities[0] / usual.linear, velocities[1] / usual.angular
    turns = np.where(angular > 0.0, _LEFT, _RIGHT)
    drives = np.where(linear > 0.0, _FORWARD, _BACKWARD)
    drives = np.where(np.abs(linear) < thresholds.still, turns, drives)
    atoms = np.where(np.abs(angular) >= thresholds.turning, turns, drives)
    stands = (np.abs(linear) < thresholds.still) & (np.abs(angular) < thresholds.still)
    return np.where(stands, _STOP, atoms).astype(np.int8)


def ahead_in_turns(velocities: Array, atoms: NDArray[np.int8], usual: Nominal) -> Array:
    """Return how fast the robot goes ahead in each tick of turning, (n,), -1 to 1 times the nominal speed; else 0."""
    ahead = np.clip(velocities[0] / usual.linear, -1.0, 1.0)
    return np.where((atoms == _LEFT) | (atoms == _RIGHT), ahead, 0.0)
