"""Velocities become atom movements.

An atom is all or nothing: forward, backward, a turn, or a stop. How fast this robot usually drives and turns is
measured on the source itself, so that one rule does for a toy car's throttle and for metres a second. A tick that does
both is a turn where the turn is sharp, as one who has only keys would drive it, and keeps how fast it went ahead.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.base import ATOMS
from services.importers.drive import Array, ImportFailure

#: Slower than this nobody drives or turns on purpose: 2 cm and 6 degrees a second. Of a source without units it is 2 %
#: of full throttle, and 10 % of full lock at that.
_LEAST_LINEAR, _LEAST_ANGULAR = 0.02, 0.1
#: The nominal speed is that which so many of the moving samples do not exceed, and so is the nominal turn rate: the
#: fastest few are noise, or a hand that slipped.
QUANTILE: Final = 0.95
#: Below this fraction of both nominal velocities the robot stands; joysticks have a dead zone of about as much.
STILL: Final = 0.1
#: From this fraction of the nominal turn rate on a tick is a turn: the nearer of all and nothing.
TURNING: Final = 0.5


class Nominal(NamedTuple):
    """How fast the robot usually drives and turns, in the source's units."""

    linear: float
    angular: float


def nominal(velocities: Array, quantile: float = QUANTILE) -> Nominal:
    """Measure it on the samples of all drives, (n, 2): linear and angular.

    Raises
    ------
    ImportFailure
        When the robot never moves.
    """
    linear, angular = np.abs(velocities).T
    driving, turning = linear[linear > _LEAST_LINEAR], angular[angular > _LEAST_ANGULAR]
    if not driving.size:
        raise ImportFailure("the robot never drives: no velocity above 0.02; are its units metres a second?")
    fast = float(np.quantile(turning, quantile)) if turning.size else _LEAST_ANGULAR
    return Nominal(float(np.quantile(driving, quantile)), fast)


def atoms_of(
    velocities: Array, usual: Nominal, still: float = STILL, turning: float = TURNING
) -> tuple[NDArray[np.int8], Array]:
    """Return what was done in each tick, by its velocities (n, 2), linear and angular.

    Returns
    -------
    atoms, ahead
        (n,) places in `ATOMS`; and (n,) how fast it goes ahead in a turn, -1 to 1 times the nominal speed, else 0.
    """
    linear, angular = (velocities / usual).T
    crawls = np.abs(linear) < still
    stands = crawls & (np.abs(angular) < still)
    turns = (crawls | (np.abs(angular) >= turning)) & ~stands
    drives = np.where(linear > 0.0, ATOMS.index("forward"), ATOMS.index("backward"))
    atoms = np.where(turns, np.where(angular > 0.0, ATOMS.index("left"), ATOMS.index("right")), drives)
    atoms[stands] = ATOMS.index("stop")
    return atoms.astype(np.int8), np.where(turns, np.clip(linear, -1.0, 1.0), 0.0)
