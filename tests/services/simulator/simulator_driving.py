"""A driver with four keys, for tests."""

from __future__ import annotations

import math
from collections.abc import Callable

from schemas.base import Atom
from services.simulator.simulation import Simulation


def drive_to(simulation: Simulation, x: float, y: float, until: Callable[[], bool] = lambda: False) -> None:
    """Turn to a place and drive there; stop there, at a collision, or when `until` says so."""
    for _ in range(600):
        pose = simulation.pose
        if math.hypot(x - pose.x, y - pose.y) < 0.3 or simulation.collided or until():
            return
        bearing = math.remainder(math.atan2(y - pose.y, x - pose.x) - pose.heading, math.tau)
        turn: Atom = "left" if bearing > 0 else "right"
        simulation.advance("forward" if abs(bearing) < 0.06 else turn, 1.0, 0.1)
    raise AssertionError(f"did not arrive at ({x}, {y})")
