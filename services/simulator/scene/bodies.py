"""Victims and robots as meshes about their own origin, x forward."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import affinity

from services.simulator.robots import RobotModel, Tag
from services.simulator.scene.meshes import ball, band, flat, make, tube
from services.simulator.scene.surfaces import Finish, Piece, Surface
from services.simulator.scene.textures import Material

Point = tuple[float, float, float]
Ball = tuple[Material, Point, Point, int]
"""What it wears, its middle, its radii, and how round it is."""
Limb = tuple[Material, Point, Point, tuple[float, float], int]
"""What it wears, its ends, its radii there, and how round it is."""

# Pixels a module of the marker, and modules of a marker with its black border.
_MODULE_PX: Final = 32
_MODULES: Final = 6
# Of a humanoid robot after the NAO, 0.58 m tall, standing upright: what is in its middle, and what is on its left; its
# right is the mirror image.
_NAO_BALLS: Final[list[Ball]] = [
    ("white_plastic", (0.0, 0.0, 0.516), (0.06, 0.066, 0.058), 18),
    ("white_plastic", (0.0, 0.0, 0.408), (0.05, 0.07, 0.05), 16),
    ("white_plastic", (0.002, 0.0, 0.362), (0.043, 0.052, 0.06), 14),
    ("white_plastic", (-0.002, 0.0, 0.283), (0.042, 0.072, 0.034), 14),
    ("orange_plastic", (0.03, 0.0, 0.412), (0.032, 0.05, 0.036), 16),
    ("orange_plastic", (-0.03, 0.0, 0.405), (0.034, 0.05, 0.04), 14),
    ("orange_plastic", (-0.012, 0.0, 0.556), (0.03, 0.016, 0.023), 10),
    ("black_plastic", (0.052, 0.0, 0.49), (0.01, 0.012, 0.006), 8),
    ("black_plastic", (0.052, 0.0, 0.548), (0.008, 0.009, 0.008), 8),
    # An eye, an ear, an arm, a leg.
    ("black_plastic", (0.046, 0.027, 0.522), (0.016, 0.017, 0.017), 12),
    ("blue_plastic", (0.0535, 0.0285, 0.522), (0.0105, 0.0105, 0.0105), 10),
    ("nao_grey", (0.0, 0.062, 0.516), (0.036, 0.014, 0.036), 14),
    ("white_plastic", (0.0, 0.068, 0.516), (0.02, 0.012, 0.02), 12),
    ("orange_plastic", (0.0, 0.1, 0.428), (0.034, 0.031, 0.036), 14),
    ("white_plastic", (0.012, 0.121, 0.326), (0.029, 0.029, 0.029), 12),
    ("nao_grey", (0.0, 0.122, 0.335), (0.031, 0.027, 0.025), 12),
    ("nao_grey", (0.076, 0.112, 0.264), (0.026, 0.019, 0.022), 12),
    ("nao_grey", (0.082, 0.096, 0.268), (0.007, 0.007, 0.007), 6),
    ("nao_grey", (0.104, 0.098, 0.258), (0.007, 0.007, 0.007), 6),
    ("white_plastic", (0.0, 0.053, 0.262), (0.043, 0.042, 0.04), 14),
    ("white_plastic", (0.02, 0.053, 0.02), (0.078, 0.044, 0.028), 14),
    ("nao_grey", (0.008, 0.053, 0.162), (0.039, 0.038, 0.03), 14),
    ("nao_grey", (0.0, 0.053, 0.058), (0.033, 0.034, 0.024), 12),
    ("orange_plastic", (0.022, 0.053, 0.222), (0.028, 0.033, 0.034), 16),
    ("orange_plastic", (0.02, 0.053, 0.106), (0.024, 0.029, 0.03), 16),
]
_NAO_LIMBS: Final[list[Limb]] = [
    ("nao_grey", (0.0, 0.0, 0.44), (0.0, 0.0, 0.475), (0.027, 0.027), 14),
    ("nao_grey", (0.0, 0.0, 0.285), (0.0, 0.0, 0.335), (0.04, 0.038), 16),
    ("white_plastic", (0.0, 0.106, 0.41), (0.0, 0.12, 0.346), (0.03, 0.027), 16),
    ("white_plastic", (0.01, 0.121, 0.328), (0.062, 0.113, 0.277), (0.029, 0.022), 16),
    ("nao_grey", (0.082, 0.096, 0.268), (0.104, 0.098, 0.258), (0.007, 0.007), 8),
    ("white_plastic", (0.0, 0.053, 0.262), (0.006, 0.053, 0.178), (0.043, 0.035), 18),
    ("white_plastic", (0.008, 0.053, 0.146), (0.0, 0.053, 0.066), (0.034, 0.037), 18),
]


def victim() -> list[Piece]:
    """Return a person of 1.75 m lying on the back, the head towards x, one arm up and one knee bent."""
    skin, jacket, trousers, shoe = (Finish(material) for material in ("skin", "jacket", "trousers", "tyre"))
    return [
        (skin, ball((0.78, 0.0, 0.12), (0.13, 0.1, 0.12), 8)),
        (skin, ball((0.72, 0.68, 0.08), (0.09, 0.06, 0.05), 6)),
        (skin, ball((-0.08, -0.42, 0.07), (0.09, 0.06, 0.05), 6)),
        (jacket, ball((0.33, 0.0, 0.15), (0.38, 0.23, 0.15), 8)),
        *_limb(jacket, (0.52, 0.2, 0.14), (0.7, 0.62, 0.09), 0.075),
        *_limb(jacket, (0.52, -0.2, 0.14), (0.0, -0.4, 0.09), 0.075),
        (trousers, ball((0.0, 0.0, 0.14), (0.2, 0.2, 0.14), 8)),
        *_limb(trousers, (-0.05, -0.1, 0.13), (-0.85, -0.16, 0.1), 0.095),
        *_limb(trousers, (-0.05, 0.1, 0.13), (-0.42, 0.22, 0.42), 0.095),
        *_limb(trousers, (-0.42, 0.22, 0.42), (-0.78, 0.24, 0.1), 0.08),
        (shoe, ball((-0.92, -0.16, 0.12), (0.09, 0.07, 0.13), 6)),
        (shoe, ball((-0.86, 0.24, 0.1), (0.13, 0.07, 0.09), 6)),
    ]


def _limb(finish: Finish, start: Point, end: Point, radius_m: float) -> list[Piece]:
    """Return a limb with round ends."""
    ends = [ball(point, (radius_m, radius_m, radius_m), 6) for point in (start, end)]
    return [(finish, part) for part in (tube(start, end, (radius_m, radius_m)), *ends)]


def nao() -> Iterator[Piece]:
    """Yield a humanoid robot after the NAO, its face towards x."""
    for side in (-1, 1):
        foot = affinity.scale(shapely.Point(0.02, side * 0.053).buffer(1.0, quad_segs=8), 0.078, 0.044)
        yield Finish("white_plastic"), band(foot, 0.0, 0.02, 1.0)
        for material, (x, y, z), radii, detail in _NAO_BALLS:
            if y or side > 0:
                yield Finish(material), ball((x, side * y, z), radii, detail)
        for material, (x, y, z), (to_x, to_y, to_z), ends, sectors in _NAO_LIMBS:
            if y or side > 0:
                yield Finish(material), tube((x, side * y, z), (to_x, side * to_y, to_z), ends, sectors)


def turtlebot(model: RobotModel) -> Iterator[Piece]:
    """Yield a TurtleBot II as the camera above sees it: plates on a round base, and wheels."""
    top, wheel = model.height_m, model.drive.wheel_radius_m
    for size, low, high in ((0.94, 0.02, 0.1), (0.9, 0.17, 0.176), (0.9, 0.29, 0.296), (0.9, top - 0.006, top)):
        outline = shapely.Point(0.0, 0.0).buffer(0.177 * size, quad_segs=10)
        yield Finish("black_plastic"), band(outline, low, high, 1.0)
        yield Finish("black_plastic"), flat(outline, high, 1.0)
    for side in (-model.drive.track_m / 2, model.drive.track_m / 2):
        yield Finish("tyre"), tube((0.0, side - 0.011, wheel), (0.0, side + 0.011, wheel), (wheel, wheel), 16)


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
