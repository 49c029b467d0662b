"""The robot's camera and the one above it, rendered by SAPIEN."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

import cv2
import numpy as np

from services.kit.going_on import each
from services.simulator.scene import vulkan
from services.simulator.scene.build import build_scene
from services.simulator.scene.culling import in_cells
from services.simulator.scene.occlusion import Occluders, looking
from services.simulator.scene.stage import Stage, load_renderer
from services.simulator.sensors.shake import LEVEL, Tilt

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from services.simulator.scene.surfaces import Scene, Vector
    from services.simulator.sensors.camera import CameraSettings
    from services.simulator.world.place import OverheadMount, Pose, World

_NEAR_M: Final = 0.1
_FAR_M: Final = 2000.0
#: What a pixel shows, told by the picture's alpha, 0 to 255; our shader takes it from the material. Colours are blended
#: by it with what was drawn there before, so all are near 255, and the victim and the robot are drawn first.
NOTHING: Final = 0
STILL: Final = 255
SKY: Final = 254
VICTIM: Final = 253
ROBOT: Final = 252


class SceneCamera:
    """A camera on the robot's mast, in a world built for it.

    Parameters
    ----------
    world
        What there is to see.
    settings
        Image size, field of view, shadows.

    Raises
    ------
    RenderingUnavailableError
        The machine has no usable Vulkan driver.
    """

    def __init__(self, world: World, settings: CameraSettings) -> None:
        load_renderer()
        self._settings = settings
        self._mount = world.robot.camera
        self._overhead = world.place.overhead
        scene = build_scene(world, settings.light, shadows=settings.shadows)
        try:
            self._fill(scene, settings)
        except RuntimeError as error:
            raise vulkan.RenderingUnavailableError(
                f"the Vulkan driver cannot render ({error}); {vulkan.INSTALL}"
            ) from error
        self._seen_from: tuple[Pose, Tilt] | None = None

    @property
    def focal_px(self) -> float:
        """Focal length in pixels of the image."""
        return self._settings.width / 2 / math.tan(math.radians(self._settings.field_of_view_deg) / 2)

    def render(self, pose: Pose, tilt: Tilt = LEVEL) -> NDArray[np.uint8]:
        """Return the image seen by a robot at `pose` whose camera is tilted, (height, width, 3) uint8 RGB."""
        self._look_from(pose, tilt)
        return _colour(self._camera, self._settings.supersample)

    def depth_m(self, pose: Pose, tilt: Tilt = LEVEL) -> NDArray[np.float32]:
        """Return how far along the optical axis each pixel's surface is, metres; `inf` for the sky and for nothing.

        Returns
        -------
        (height, width) float32, exact to a millimetre up to 40 m; with supersampling, of one of the rendered pixels
        each.
        """
        every = self._settings.supersample
        one = np.s_[every // 2 :: every, every // 2 :: every]
        shown = self._labels(pose, tilt)[one]
        # The depth buffer holds 0 at the near plane and 1 at the far one, and is linear in the inverse of the depth.
        buffer = self._camera.get_picture("GbufferDepth")[one].astype(np.float64)
        depth = _NEAR_M * _FAR_M / (_FAR_M - buffer * (_FAR_M - _NEAR_M))
        return np.where((shown == NOTHING) | (shown == SKY), np.inf, depth).astype(np.float32)

    def overhead(self, pose: Pose) -> NDArray[np.uint8]:
        """Return what the camera above the scene sees of a robot at `pose`, (height, width, 3) uint8 RGB.

        Raises
        ------
        LookupError
            The place has no such camera.
        """
        if self._above is None:
            raise LookupError("this place has no overhead camera")
        every_cell = range(len(self._cells.surfaces))
        if self._seen_from is None or pose != self._seen_from[0] or not set(every_cell) <= set(self._stage.shown):
            self._robot.set_pose(self._pose((pose.x, pose.y, 0.0), _turn(pose.heading)))
            self._show(every_cell)
            self._stage.scene.update_render()
            # The scene is no longer the one in the robot's own picture.
            self._seen_from = None
        self._above.take_picture()
        return _colour(self._above)

    def look(self, eye: Vector, at: Vector) -> NDArray[np.uint8]:
        """Return what the camera would see off its mast, from one place to another, (height, width, 3) uint8 RGB.

        Parameters
        ----------
        eye, at
            x, y and height in metres, not one above the other; the horizon is level.
        """
        ahead = np.subtract(at, eye) / np.linalg.norm(np.subtract(at, eye))
        left = np.cross((0.0, 0.0, 1.0), ahead)
        left /= np.linalg.norm(left)
        frame = np.eye(4)
        frame[:3] = np.column_stack([ahead, left, np.cross(ahead, left), eye])
        self._take(self._pose(frame))
        self._seen_from = None
        return _colour(self._camera, self._settings.supersample)

    def victim_pixels(self, pose: Pose, tilt: Tilt = LEVEL) -> float:
        """Return the fraction of the image, 0 to 1, that the victim fills, seen by a robot at `pose`."""
        return float(np.mean(self._labels(pose, tilt) == VICTIM))

    def _labels(self, pose: Pose, tilt: Tilt = LEVEL) -> NDArray[np.uint8]:
        """Return what each rendered pixel shows: `NOTHING`, `SKY`, `STILL`, `VICTIM` or `ROBOT`."""
        self._look_from(pose, tilt)
        return np.asarray(self._camera.get_picture("Color")[..., 3])

    def _look_from(self, pose: Pose, tilt: Tilt) -> None:
        if (pose, tilt) == self._seen_from:
            return
        cos, sin = math.cos(pose.heading), math.sin(pose.heading)
        ahead_m = self._mount.ahead_m
        eye = (pose.x + ahead_m * cos, pose.y + ahead_m * sin, self._mount.height_m)
        self._robot.set_pose(self._pose((pose.x, pose.y, 0.0), _turn(pose.heading)))
        self._take(self._pose(eye, _turn(pose.heading, tilt)))
        self._seen_from = pose, tilt

    def _take(self, mast: Any) -> None:  # noqa: ANN401 - sapien has no types
        """Take a picture from where SAPIEN's pose `mast` is."""
        self._mast.set_pose(mast)
        if self._sky is not None:
            self._sky.set_pose(self._pose(mast.p))
        frame = mast.to_transformation_matrix()
        self._show(self._seen(np.asarray(mast.p, dtype=np.float64), frame[:3, :3].T))
        self._stage.scene.update_render()
        self._camera.take_picture()

    def _seen(self, eye: NDArray[np.float64], axes: NDArray[np.float64]) -> list[int]:
        """Return the cells to draw for an eye (3,) and the axes (3, 3) of its camera, the nearest first."""
        in_view = self._cells.seen(eye, axes, self._tangents, self._horizon_m)
        hidden = self._occluders.hidden(looking(eye, axes, self._tangents), self._cells.boxes[in_view])
        return [cell for cell, is_hidden in zip(in_view, hidden, strict=True) if not is_hidden]

    def _fill(self, scene: Scene, settings: CameraSettings) -> None:
        self._stage = Stage(scene.lights)
        self._pose = self._stage.sapien.Pose
        self._stage.add(scene.victim, VICTIM)
        self._robot = self._stage.add(scene.robot, ROBOT)
        self._cells = in_cells(scene.still)
        self._occluders = Occluders(scene.blocks)
        for cell in each(self._cells.surfaces):
            self._stage.hang(self._stage.add(cell, STILL))
        self._sky = None if scene.sky is None else self._stage.add([scene.sky], SKY)
        self._behind = [] if self._sky is None else [self._stage.hang(self._sky)]
        # The dome hides what is further away.
        self._horizon_m = _FAR_M if scene.sky is None else float(np.linalg.norm(scene.sky.mesh.vertices, axis=1).max())
        self._tangents = settings.width / 2 / self.focal_px, settings.height / 2 / self.focal_px
        self._camera = self._lens(settings.width, settings.height, self.focal_px, settings.supersample)
        self._mast = self._stage.entity(self._camera)
        self._above = None if self._overhead is None else self._look_down(self._overhead)

    def _look_down(self, mount: OverheadMount) -> Any:  # noqa: ANN401 - sapien has no types
        """Add a camera that looks straight down; a camera's axes are ahead, left and up."""
        camera = self._lens(mount.width, mount.height, mount.focal_px)
        cos, sin = math.cos(mount.up), math.sin(mount.up)
        frame = np.eye(4)
        frame[:3] = [[0.0, -sin, cos, mount.x], [0.0, cos, sin, mount.y], [-1.0, 0.0, 0.0, mount.height_m]]
        self._stage.entity(camera).set_pose(self._pose(frame))
        return camera

    def _lens(self, width: int, height: int, focal_px: float, supersample: int = 1) -> Any:  # noqa: ANN401 - see above
        width, height, focal = width * supersample, height * supersample, focal_px * supersample
        camera = self._stage.sapien.render.RenderCameraComponent(width, height)
        camera.set_perspective_parameters(_NEAR_M, _FAR_M, focal, focal, width / 2, height / 2, 0.0)
        return camera

    def _show(self, cells: Sequence[int]) -> None:
        """Have these cells drawn, in this order, and the sky behind them."""
        self._stage.show([*cells, *self._behind])


def _turn(heading: float, tilt: Tilt = LEVEL) -> tuple[float, float, float, float]:
    """Return a heading, and a tilt on top of it, as a unit quaternion (w, x, y, z)."""
    roll, pitch, yaw = tilt.roll_rad / 2, tilt.pitch_rad / 2, (heading + tilt.yaw_rad) / 2
    cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    cy, sy = math.cos(yaw), math.sin(yaw)
    return (
        cy * cp * cr + sy * sp * sr,
        cy * cp * sr - sy * sp * cr,
        cy * sp * cr + sy * cp * sr,
        sy * cp * cr - cy * sp * sr,
    )


def _colour(camera: Any, supersample: int = 1) -> NDArray[np.uint8]:  # noqa: ANN401 - sapien has no types
    """Return the picture that a camera took, (height, width, 3), averaged where it was rendered larger."""
    large = np.asarray(cv2.cvtColor(camera.get_picture("Color"), cv2.COLOR_RGBA2RGB), dtype=np.uint8)
    if supersample == 1:
        return large
    size = (large.shape[1] // supersample, large.shape[0] // supersample)
    return np.asarray(cv2.resize(large, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
