"""One step of the robot's motion, as the sensors get it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from services.simulator.world.place import Pose


@dataclass(frozen=True)
class Step:
    """How the robot moved from one reading of its sensors to the next.

    Attributes
    ----------
    before, after
        True poses at both ends.
    rolled_m
        How far the left and the right wheel turned, metres of the rim.
    duration_s
        Time between the two, greater than 0.
    """

    before: Pose
    after: Pose
    rolled_m: tuple[float, float]
    duration_s: float

    @property
    def velocity_m_s(self) -> tuple[float, float]:
        """Mean velocity, east and north."""
        return (
            (self.after.x - self.before.x) / self.duration_s,
            (self.after.y - self.before.y) / self.duration_s,
        )

    @property
    def turn_rate_rad_s(self) -> float:
        """Mean turn rate, anticlockwise."""
        return math.remainder(self.after.heading - self.before.heading, math.tau) / self.duration_s
