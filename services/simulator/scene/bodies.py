"""Meshes of victims and robots about their own origin, x forward."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from services.simulator.robots import RobotModel, TagMount
from services.simulator.scene.meshes import UPRIGHT, ball, drum, quads, tube
from services.simulator.scene.surfaces import Finish, Piece, Surface, Vector
from services.simulator.tables import table

# Pixels of a marker module, and modules of a marker with its black border.
_MODULE_PX: Final = 32
_MODULES: Final = 6


@dataclass(frozen=True)
class BodyMesh:
    """An entry of the table `bodies`."""

    mirrored: bool
    balls: list[tuple[str, Vector, Vector, int]]
    limbs: list[tuple[str, Vector, Vector, tuple[float, float], int]]


#: Things of the victim's size that can replace it.
OUTDOOR_DECOYS: Final = ("sacks", "trunk", "barrels")
INDOOR_DECOYS: Final = ("bottle", "cartons", "bin")
_BODIES: Final = table("bodies", dict[str, BodyMesh])


def body(name: str) -> Iterator[Piece]:
    """Yield the pieces of a body from the table."""
    parts = _BODIES[name]
    for side in (1, -1) if parts.mirrored else (1,):
        for material, (x, y, z), radii, detail in parts.balls:
            if y or side > 0:
                yield Finish(material), ball((x, side * y, z), radii, detail)
        for material, (x, y, z), (to_x, to_y, to_z), ends, sectors in parts.limbs:
            if y or side > 0:
                yield (
                    Finish(material),
                    tube((x, side * y, z), (to_x, side * to_y, to_z), ends, sectors),
                )


def turtlebot(model: RobotModel) -> Iterator[Piece]:
    """Yield a TurtleBot II as seen from above: plates on a round base, and wheels."""
    top = model.height_m
    wheel = model.drive.wheel_radius_m
    for size, low, high in (
        (0.94, 0.02, 0.1),
        (0.9, 0.17, 0.176),
        (0.9, 0.29, 0.296),
        (0.9, top - 0.006, top),
    ):
        yield Finish("black_plastic"), drum((0.0, 0.0, low), (0.0, 0.0, high), 0.177 * size, 40)
    for side in (-model.drive.track_m / 2, model.drive.track_m / 2):
        yield Finish("tyre"), drum((0.0, side - 0.011, wheel), (0.0, side + 0.011, wheel), wheel)


def tag(marker: TagMount) -> Surface:
    """Return a marker on a white plate, its upper edge towards x."""
    known = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    square = cv2.aruco.generateImageMarker(known, marker.number, _MODULES * _MODULE_PX)
    # Detectors need a margin of one white module.
    plate = np.pad(square, _MODULE_PX, constant_values=255)
    half = marker.side_m * (0.5 + 1 / _MODULES)
    corners = [
        (x, y, marker.height_m)
        for x, y in ((-half, half), (-half, -half), (half, -half), (half, half))
    ]
    return Surface(quads([corners], [UPRIGHT]), np.repeat(plate[..., None], 3, axis=2))
