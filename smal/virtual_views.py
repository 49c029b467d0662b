"""Views from where nobody drove: a taught image as a camera a little aside, or turned, would have seen it.

One drive shows every place from one pose. A robot that drifts sees it from others, and the paper needs a demonstration
for each. We warp the taught image instead. A pure turn is a homography, exact whatever the scene is. For a step aside
or ahead we need distances, and take the simplest scene that has any: flat ground under the camera, and everything above
it at one distance. Focal length, height of the camera and that distance are those by which views that were taught
predict other views of the same drive best (`smal.calibration.fit_scene`), so nobody has to measure them.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smal.demonstration import Image
from smal.settings import SETTINGS

#: Turns of the virtual views, degrees.
TURNS_DEG = np.array(SETTINGS.turns_deg)
Maps = tuple[NDArray[Any], NDArray[Any]]


def focal_of(field_deg: float) -> float:
    """Return the focal length over the image's width of a field of view in degrees."""
    return 0.5 / math.tan(math.radians(field_deg) / 2.0)


#: Focal length that is assumed where no drive turns.
USUAL_FOCAL = focal_of(SETTINGS.usual_field_deg)


@dataclass(frozen=True)
class Scene:
    """A pinhole camera over flat ground, before a wall all round.

    Parameters
    ----------
    focal : float
        Focal length over the image's width, above 0; the optical axis meets the image in its middle, and is level.
    height : float
        Of the camera above the ground, above 0.
    distance : float
        Of everything above the ground, above 0; in the same unit as the height.
    """

    focal: float
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

        rows, columns = shape
        focal = self.focal * columns
        middle_u, middle_v = (columns - 1) / 2.0, (rows - 1) / 2.0
        v, u = np.mgrid[0:rows, 0:columns].astype(np.float32)
        across, down = (u - middle_u) / focal, (v - middle_v) / focal
        # The ray of each pixel, in axes of the camera that took the image: right, down, ahead.
        right = math.cos(turn_rad) * across - math.sin(turn_rad)
        deep = math.sin(turn_rad) * across + math.cos(turn_rad)
        # How far along the ray the ground or the wall is, whichever comes first.
        reach = 1.0 / np.maximum(down / self.height, np.hypot(right, deep) / self.distance)
        # A point behind the image has no pixel; far outside it, the border is repeated.
        z = np.maximum(reach * deep + ahead, 1e-3 * self.height)
        x, y = reach * right - left, reach * down
        return cv2.convertMaps(
            (focal * x / z + middle_u).astype(np.float32), (focal * y / z + middle_v).astype(np.float32), cv2.CV_16SC2
        )


def remapped(image: Image, maps: Maps) -> Image:
    """Return another view of an image (height, width, 3); maps are made once for many images (`Scene.maps`)."""
    import cv2  # noqa: PLC0415 - see above

    return np.asarray(
        cv2.remap(image, maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), dtype=np.uint8
    )
