"""The robot indoors as meshes about its own origin, x forward: a TurtleBot II, and the marker on top of it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import cv2
import numpy as np
import shapely
from shapely import box

from services.simulator.scene.meshes import make
from services.simulator.scene.shapes import band, flat, tube
from services.simulator.scene.surfaces import Surface

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from services.simulator.robots import RobotModel, Tag
    from services.simulator.scene.meshes import Mesh
    from services.simulator.scene.textures import Material

#: Pixels a module of the marker, and modules of a marker with its black border.
_MODULE_PX: Final = 32
_MODULES: Final = 6
#: White around the marker's black square; what finds markers needs one module.
_MARGIN_MODULES: Final = 1.0
_PLATE_M: Final = 0.006


def turtlebot(model: RobotModel) -> dict[Material, list[Mesh]]:
    """Return a TurtleBot II: Kobuki's round base, plates on poles, a camera bar, a small computer between plates."""
    half_track, wheel = model.drive.track_m / 2, model.drive.wheel_radius_m
    radius, top = 0.177, model.height_m
    black = [
        *_disc(0.94 * radius, 0.02, 0.1), *_disc(0.8 * radius, 0.1, 0.122),
        *_disc(0.9 * radius, 0.17, 0.17 + _PLATE_M), *_disc(0.9 * radius, 0.29, 0.29 + _PLATE_M),
        *_disc(0.9 * radius, top - _PLATE_M, top),
    ]  # fmt: skip
    poles = [(x, y) for x in (-0.1, 0.04) for y in (-0.11, 0.11)]
    ahead, height = model.camera.ahead_m, model.camera.height_m
    sensor = box(ahead - 0.045, -0.09, ahead - 0.005, 0.09)
    computer = box(-0.13, -0.1, 0.06, 0.1)
    tag_m = top if model.tag is None else model.tag.height_m
    return {
        "black_plastic": black,
        "dark_plastic": [
            *_disc(radius, 0.03, 0.075),
            *_slab(sensor, height - 0.018, height + 0.018),
            tube((ahead - 0.025, 0.0, 0.29), (ahead - 0.025, 0.0, height - 0.018), (0.012, 0.012), 8),
        ],
        "aluminium": [
            *(tube((x, y, 0.12), (x, y, top - _PLATE_M), (0.007, 0.007), 8) for x, y in poles),
            *(tube((x, y, top), (x, y, tag_m - _PLATE_M), (0.005, 0.005), 6) for x, y in poles),
            *_slab(computer, 0.178, 0.2),
        ],
        "white_plastic": _disc(0.3 * radius, 0.1225, 0.1235),
        "tyre": [
            tube((0.0, side - 0.011, wheel), (0.0, side + 0.011, wheel), (wheel, wheel), 16)
            for side in (-half_track, half_track)
        ],
    }


def tag(model: RobotModel) -> Surface | None:
    """Return the marker on a robot: a round white plate, the marker's upper edge towards x; None without one."""
    if model.tag is None:
        return None
    radius = plate_radius_m(model.tag)
    plate = shapely.Point(0.0, 0.0).buffer(radius, quad_segs=16)
    mesh = flat(plate, model.tag.height_m, 1.0)
    # Seen from above with x up, the picture's columns go to -y and its rows to -x.
    across, down = (0.5 - mesh.vertices[:, axis] / (2 * radius) for axis in (1, 0))
    worn = make(mesh.vertices, mesh.normals, np.column_stack([across, down]), mesh.triangles)
    return Surface(worn, _marker(model.tag))


def plate_radius_m(marker: Tag) -> float:
    """Return the radius of the plate around a marker, so that its corners keep their white margin."""
    module = marker.side_m / _MODULES
    return float(np.hypot(marker.side_m / 2, marker.side_m / 2)) + _MARGIN_MODULES * module


def _marker(marker: Tag) -> NDArray[np.uint8]:
    """Return the picture of the plate, (n, n, 3) uint8 RGB, its side twice the plate's radius."""
    square = cv2.aruco.generateImageMarker(
        cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), marker.number, _MODULES * _MODULE_PX
    )
    side = round(2 * plate_radius_m(marker) / marker.side_m * len(square))
    before = (side - len(square)) // 2
    after = side - len(square) - before
    plate = cv2.copyMakeBorder(square, before, after, before, after, cv2.BORDER_CONSTANT, value=255)
    return np.repeat(plate[..., None], 3, axis=2)


def _disc(radius: float, low: float, high: float) -> list[Mesh]:
    return _slab(shapely.Point(0.0, 0.0).buffer(radius, quad_segs=10), low, high)


def _slab(outline: shapely.Polygon, low: float, high: float) -> list[Mesh]:
    return [band(outline, low, high, 1.0), flat(outline, high, 1.0), flat(outline, low, 1.0).flipped()]
