"""Views from where nobody drove: a taught image as a camera a little aside, or turned, would have seen it.

One drive shows every place from one pose. A robot that drifts sees it from others, and the paper needs a demonstration
for each. We warp the taught image instead. A pure turn is exact whatever the scene is. For a step aside or ahead we
need distances, and take the simplest scene that has any: flat ground under the camera, and everything above it at one
distance. The camera, its height and that distance are those by which views that were taught predict other
views of the same drive best (`smal.calibration`), so nobody has to measure them.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smal.camera import Camera
from smal.demonstration import Image
from smal.settings import SETTINGS

#: Turns of the virtual views, degrees.
TURNS_DEG = np.array(SETTINGS.turns_deg)
Maps = tuple[NDArray[Any], NDArray[Any]]


@dataclass(frozen=True)
class Scene:
    """A camera over flat ground, before a wall all round.

    Parameters
    ----------
    camera : Camera
    height : float
        Of the camera above the ground, above 0.
    distance : float
        Of everything above the ground, above 0; in the same unit as the height.
    """

    camera: Camera
    height: float
    distance: float

    def warp(self, image: Image, ahead: float = 0.0, left: float = 0.0, turn_rad: float = 0.0) -> Image:
        """Return what is seen from a pose beside the one at which an image was taken.

        Parameters
        ----------
        image : uint8 array (height, width, 3)
        ahead, left : float
            Where the other pose is, in the unit of the scene.
        turn_rad : float
            How far it is turned left.

        Returns
        -------
        uint8 array (height, width, 3)
            What the image does not show repeats its border.
        """
        return remapped(image, self.maps(image.shape[:2], ahead, left, turn_rad))

    def maps(self, shape: tuple[int, ...], ahead: float, left: float, turn_rad: float) -> Maps:
        """Return where each pixel of the other view lies in an image of this shape, for `remapped`."""
        import cv2  # noqa: PLC0415 - processes that only read models have no OpenCV

        focal = self.camera.focal * shape[1]
        middle_u, middle_v = self.camera.middle(shape)
        # Of each pixel, in axes of the camera that took the image.
        x, y, z = self.camera.rays(shape)
        right = math.cos(turn_rad) * x - math.sin(turn_rad) * z
        deep = math.sin(turn_rad) * x + math.cos(turn_rad) * z
        # How far along the ray the ground or the wall is, whichever comes first.
        reach = 1.0 / np.maximum(y / self.height, np.hypot(right, deep) / self.distance)
        x, y, z = reach * right - left, reach * y, reach * deep + ahead
        off = np.maximum(np.hypot(x, y), 1e-9)
        # Far outside of the image its border is repeated.
        radius = np.minimum(self.camera.radius(np.arctan2(off, z)), 100.0) * focal / off
        return cv2.convertMaps(
            (radius * x + middle_u).astype(np.float32), (radius * y + middle_v).astype(np.float32), cv2.CV_16SC2
        )


def remapped(image: Image, maps: Maps) -> Image:
    """Return another view of an image (height, width, 3); maps are made once for many images (`Scene.maps`)."""
    import cv2  # noqa: PLC0415 - see above

    return np.asarray(
        cv2.remap(image, maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), dtype=np.uint8
    )
