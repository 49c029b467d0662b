"""The robot's camera as the simulation knows it: its settings, and what it can be asked for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from services.simulator.variation import DAY, Daylight

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from services.simulator.sensors.shake import Tilt
    from services.simulator.world.place import Pose


@dataclass(frozen=True)
class CameraSettings:
    """The robot's camera: image size in pixels, shadows of the sun, how wide it sees, and in what light.

    Attributes
    ----------
    supersample
        Pixels rendered per image pixel along each axis, averaged; more smooths edges and costs its square in time.
    """

    width: int = 1024
    height: int = 768
    shadows: bool = True
    field_of_view_deg: float = 75.0
    supersample: int = 1
    light: Daylight = DAY.light


class Camera(Protocol):
    """The robot's eye, and the one above it; `rendering.SceneCamera` is the real one."""

    @property
    def focal_px(self) -> float:
        """Focal length of the robot's eye in pixels."""

    def render(self, pose: Pose, tilt: Tilt) -> NDArray[np.uint8]:
        """Return the image seen from `pose` by a camera that is tilted there."""

    def depth_m(self, pose: Pose, tilt: Tilt) -> NDArray[np.float32]:
        """Return how far along the optical axis each pixel's surface is, (height, width) metres or `inf`."""

    def victim_pixels(self, pose: Pose, tilt: Tilt) -> float:
        """Return the fraction of the image, 0 to 1, that the victim fills, seen from `pose`."""

    def overhead(self, pose: Pose) -> NDArray[np.uint8]:
        """Return what the camera above the scene, if there is one, sees of a robot at `pose`."""
