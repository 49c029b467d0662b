"""Driven route of a robot, with its length."""

import math
from typing import Final

#: Maximum number of points of a route (above it, every second point is dropped), and their
#: spacing. The spacing keeps the noise of a standing robot out of the length.
_POINTS: Final = 400
_APART_M: Final = 0.1


class DrivenRoute:
    """Points of a route in metres, and its length."""

    def __init__(self) -> None:
        self.points: list[tuple[float, float]] = []
        self.metres = 0.0

    def add(self, x_m: float, y_m: float) -> bool:
        """Add a position; return whether it was far enough from the last point to count."""
        here = (round(x_m, 2), round(y_m, 2))
        if self.points:
            step_m = math.dist(here, self.points[-1])
            if step_m < _APART_M:
                return False
            self.metres += step_m
        self.points.append(here)
        if len(self.points) > _POINTS:
            del self.points[1:-1:2]
        return True
