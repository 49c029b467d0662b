"""Cameras, and a driver with four keys, for tests."""

import math
from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from schemas.base import KEYS, Atom
from services.simulator.scene.rendering import SceneCamera
from services.simulator.sensors.camera import CameraSettings
from services.simulator.sensors.readings import Tilt
from services.simulator.simulation import Simulation
from services.simulator.world import load_world
from services.simulator.world.place import Pose


@cache
def camera_in(name: str) -> SceneCamera:
    """Return the rendered camera of a world, 160x120, that tests share."""
    return SceneCamera(load_world(name), CameraSettings(160, 120))


class StubCamera:
    """Sees the victim as a given fraction of the image, and remembers whether it was asked."""

    focal_px = 20.0

    def __init__(self, fraction: float = 0.0) -> None:
        self.fraction = fraction
        self.asked = 0

    def lay(self, victim: Pose | None, decoy: Pose | None = None, which: int = 0) -> None:
        pass

    def walk(self, people: tuple[Pose, ...]) -> None:
        pass

    def render(self, pose: Pose, tilt: Tilt) -> NDArray[np.uint8]:
        return np.full((24, 32, 3), int(abs(pose.x)) % 256, dtype=np.uint8)

    def depth_m(self, pose: Pose, tilt: Tilt) -> NDArray[np.float32]:
        return np.full((24, 32), abs(pose.x), dtype=np.float32)

    def overhead(self, pose: Pose) -> NDArray[np.uint8]:
        raise LookupError("nothing above")

    def victim_pixels(self, pose: Pose, tilt: Tilt) -> float:
        self.asked += 1
        return self.fraction


def key_to(pose: Pose, x: float, y: float) -> Atom:
    """Return the key that turns to a place, or drives there."""
    bearing = math.remainder(math.atan2(y - pose.y, x - pose.x) - pose.heading, math.tau)
    return "forward" if abs(bearing) < 0.06 else "left" if bearing > 0 else "right"


def drive_to(
    simulation: Simulation, x: float, y: float, until: Callable[[], bool] = lambda: False
) -> None:
    """Turn to a place and drive there; stop there, at a collision, or when `until` says so."""
    for _ in range(600):
        pose = simulation.pose
        if math.hypot(x - pose.x, y - pose.y) < 0.3 or simulation.collided or until():
            return
        simulation.advance(KEYS[key_to(pose, x, y)], 0.1)
    raise AssertionError(f"did not arrive at ({x}, {y})")
