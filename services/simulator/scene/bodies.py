"""The victim outdoors and the robots as meshes about their own origin, x forward."""

from __future__ import annotations

from typing import TYPE_CHECKING

from shapely import box

from services.simulator.robots import TURTLEBOT
from services.simulator.scene.shapes import ball, band, flat, tube
from services.simulator.scene.turtlebot import turtlebot

if TYPE_CHECKING:
    from services.simulator.robots import RobotModel
    from services.simulator.scene.meshes import Mesh
    from services.simulator.scene.textures import Material

Point = tuple[float, float, float]


def victim() -> dict[Material, list[Mesh]]:
    """Return a person of 1.75 m lying on the back, the head towards x, one arm up and one knee bent."""
    return {
        "skin": [
            ball((0.78, 0.0, 0.12), (0.13, 0.1, 0.12), 8),
            ball((0.72, 0.68, 0.08), (0.09, 0.06, 0.05), 6),
            ball((-0.08, -0.42, 0.07), (0.09, 0.06, 0.05), 6),
        ],
        "jacket": [
            ball((0.33, 0.0, 0.15), (0.38, 0.23, 0.15), 8),
            *limb((0.52, 0.2, 0.14), (0.7, 0.62, 0.09), 0.075),
            *limb((0.52, -0.2, 0.14), (0.0, -0.4, 0.09), 0.075),
        ],
        "trousers": [
            ball((0.0, 0.0, 0.14), (0.2, 0.2, 0.14), 8),
            *limb((-0.05, -0.1, 0.13), (-0.85, -0.16, 0.1), 0.095),
            *limb((-0.05, 0.1, 0.13), (-0.42, 0.22, 0.42), 0.095),
            *limb((-0.42, 0.22, 0.42), (-0.78, 0.24, 0.1), 0.08),
        ],
        "tyre": [ball((-0.92, -0.16, 0.12), (0.09, 0.07, 0.13), 6), ball((-0.86, 0.24, 0.1), (0.13, 0.07, 0.09), 6)],
    }


def robot(model: RobotModel) -> dict[Material, list[Mesh]]:
    """Return a robot's body, without the marker that it may carry."""
    return turtlebot(model) if model.name == TURTLEBOT.name else _rescuebot(model)


def _rescuebot(model: RobotModel) -> dict[Material, list[Mesh]]:
    """Return the Rescuebot: a box between two wheels with a mast for the camera."""
    hull = box(-0.35, -0.22, 0.3, 0.22)
    mast = (0.25, 0.0)
    return {
        "robot": [band(hull, 0.12, 0.45, 1.0), flat(hull, 0.45, 1.0)],
        "tyre": [
            tube((0.0, side - 0.04, 0.2), (0.0, side + 0.04, 0.2), (0.2, 0.2), 16) for side in (-0.3, 0.3)
        ] + [tube((*mast, 0.45), (*mast, model.camera.height_m), (0.03, 0.03))],
    }  # fmt: skip


def limb(start: Point, end: Point, radius_m: float) -> list[Mesh]:
    """Return a limb with round ends."""
    ends = [ball(point, (radius_m, radius_m, radius_m), 6) for point in (start, end)]
    return [tube(start, end, (radius_m, radius_m)), *ends]
