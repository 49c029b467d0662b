"""Victims and robots as meshes about their own origin, x forward."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray

from services.simulator.robots import RobotModel, Tag
from services.simulator.scene.meshes import ball, drum, flat, make, tube
from services.simulator.scene.surfaces import Finish, Piece, Surface, Vector
from services.simulator.tables import table

# Pixels a module of the marker, and modules of a marker with its black border.
_MODULE_PX: Final = 32
_MODULES: Final = 6


@dataclass(frozen=True)
class Body:
    """An entry of the table `bodies`, which says what is in it."""

    mirrored: bool
    balls: list[tuple[str, Vector, Vector, int]]
    limbs: list[tuple[str, Vector, Vector, tuple[float, float], int]]


_BODIES: Final = table("bodies", dict[str, Body])


def body(name: str) -> Iterator[Piece]:
    """Yield a body of the table."""
    made = _BODIES[name]
    for side in (1, -1) if made.mirrored else (1,):
        for material, (x, y, z), radii, detail in made.balls:
            if y or side > 0:
                yield Finish(material), ball((x, side * y, z), radii, detail)
        for material, (x, y, z), (to_x, to_y, to_z), ends, sectors in made.limbs:
            if y or side > 0:
                yield Finish(material), tube((x, side * y, z), (to_x, side * to_y, to_z), ends, sectors)


def turtlebot(model: RobotModel) -> Iterator[Piece]:
    """Yield a TurtleBot II as the camera above sees it: plates on a round base, and wheels."""
    top, wheel = model.height_m, model.drive.wheel_radius_m
    for size, low, high in ((0.94, 0.02, 0.1), (0.9, 0.17, 0.176), (0.9, 0.29, 0.296), (0.9, top - 0.006, top)):
        yield Finish("black_plastic"), drum((0.0, 0.0, low), (0.0, 0.0, high), 0.177 * size, 40)
    for side in (-model.drive.track_m / 2, model.drive.track_m / 2):
        yield Finish("tyre"), drum((0.0, side - 0.011, wheel), (0.0, side + 0.011, wheel), wheel)


def tag(marker: Tag) -> Surface:
    """Return a marker on a round white plate, its upper edge towards x."""
    # Its corners keep a margin of one white module, which what finds markers needs.
    radius = math.sqrt(0.5) * marker.side_m + marker.side_m / _MODULES
    mesh = flat(shapely.Point(0.0, 0.0).buffer(radius, quad_segs=16), marker.height_m, 1.0)
    # Seen from above with x up, the picture's columns go to -y and its rows to -x.
    across, down = (0.5 - mesh.vertices[:, axis] / (2 * radius) for axis in (1, 0))
    worn = make(mesh.vertices, mesh.normals, np.column_stack([across, down]), mesh.triangles)
    return Surface(worn, _painted(marker, radius))


def _painted(marker: Tag, radius: float) -> NDArray[np.uint8]:
    """Return the picture of the plate, (n, n, 3) uint8 RGB, its side twice the plate's radius."""
    known = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    square = cv2.aruco.generateImageMarker(known, marker.number, _MODULES * _MODULE_PX)
    side = round(2 * radius / marker.side_m * len(square))
    before = (side - len(square)) // 2
    after = side - len(square) - before
    plate = cv2.copyMakeBorder(square, before, after, before, after, cv2.BORDER_CONSTANT, value=255)
    return np.repeat(plate[..., None], 3, axis=2)
