"""The robot's camera, rendered by SAPIEN: the only file that imports the renderer."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final

import cv2
import numpy as np

from services.simulator.scene import vulkan
from services.simulator.scene.build import build_scene

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from services.simulator.scene.surfaces import Scene, Surface
    from services.simulator.simulation import CameraSettings
    from services.simulator.world.place import Pose, World

_NEAR_M: Final = 0.1
_FAR_M: Final = 2000.0
_MOST_PICTURES: Final = 2048


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
        self._sapien = _load_renderer()
        self._settings = settings
        self._mount = world.robot.camera
        scene = build_scene(world, shadows=settings.shadows)
        try:
            self._fill(scene, settings)
        except RuntimeError as error:
            raise vulkan.RenderingUnavailableError(
                f"the Vulkan driver cannot render ({error}); {vulkan.INSTALL}"
            ) from error
        self._seen_from: Pose | None = None

    def render(self, pose: Pose) -> NDArray[np.uint8]:
        """Return the image seen by a robot at `pose`, (height, width, 3) uint8 RGB."""
        self._look_from(pose)
        large = np.ascontiguousarray(self._camera.get_picture("Color")[..., :3])
        if self._settings.supersample == 1:
            return large
        size = (self._settings.width, self._settings.height)
        return np.asarray(cv2.resize(large, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)

    def victim_pixels(self, pose: Pose) -> float:
        """Return the fraction of the image, 0 to 1, that the victim fills, seen by a robot at `pose`."""
        self._look_from(pose)
        number = self._camera.get_picture("PositionSegmentation")[..., 3]
        return float(np.mean(number == self._victim.per_scene_id))

    def _look_from(self, pose: Pose) -> None:
        if pose == self._seen_from:
            return
        cos, sin = math.cos(pose.heading), math.sin(pose.heading)
        ahead_m = self._mount.ahead_m
        eye = (pose.x + ahead_m * cos, pose.y + ahead_m * sin, self._mount.height_m)
        turn = (math.cos(pose.heading / 2), 0.0, 0.0, math.sin(pose.heading / 2))
        self._mast.set_pose(self._sapien.Pose(eye, turn))
        self._robot.set_pose(self._sapien.Pose((pose.x, pose.y, 0.0), turn))
        if self._sky is not None:
            self._sky.set_pose(self._sapien.Pose(eye))
        self._scene.update_render()
        self._camera.take_picture()
        self._seen_from = pose

    def _fill(self, scene: Scene, settings: CameraSettings) -> None:
        render = self._sapien.render
        self._scene = self._sapien.Scene([render.RenderSystem()])
        self._scene.set_ambient_light(scene.lights.ambient)
        for direction, colour in scene.lights.directional:
            self._scene.add_directional_light(direction, colour, shadow=False)
        self._add(scene.still)
        self._sky = None if scene.sky is None else self._add([scene.sky])
        self._victim = self._add(scene.victim)
        self._robot = self._add(scene.robot)
        width, height = settings.width * settings.supersample, settings.height * settings.supersample
        self._camera = render.RenderCameraComponent(width, height)
        focal = width / 2 / math.tan(math.radians(settings.field_of_view_deg) / 2)
        self._camera.set_perspective_parameters(_NEAR_M, _FAR_M, focal, focal, width / 2, height / 2, 0.0)
        self._mast = self._sapien.Entity()
        self._mast.add_component(self._camera)
        self._scene.add_entity(self._mast)

    def _add(self, surfaces: Iterable[Surface]) -> Any:  # noqa: ANN401 - sapien has no types
        """Add one entity of all the surfaces; one entity has one number in the segmentation."""
        render = self._sapien.render
        body = render.RenderBodyComponent()
        for surface in surfaces:
            mesh = surface.mesh
            material = _material(render, surface)
            body.attach(render.RenderShapeTriangleMesh(mesh.vertices, mesh.triangles, mesh.normals, mesh.uvs, material))
        entity = self._sapien.Entity()
        entity.add_component(body)
        self._scene.add_entity(entity)
        return entity


def _material(render: Any, surface: Surface) -> Any:  # noqa: ANN401 - sapien has no types
    height, width, _ = surface.picture.shape
    opaque = np.dstack([surface.picture, np.full((height, width), 255, dtype=np.uint8)])
    levels = int(math.log2(max(height, width))) + 1
    texture = render.RenderTexture2D(opaque, "R8G8B8A8Unorm", levels, "linear", "repeat", srgb=True)
    material = render.RenderMaterial(base_color=[0.0, 0.0, 0.0, 1.0], specular=0.0, roughness=1.0, metallic=0.0)
    if surface.glows:
        material.set_emission_texture(texture)
    else:
        material.set_base_color_texture(texture)
    return material


@lru_cache(maxsize=1)
def _load_renderer() -> Any:  # noqa: ANN401 - sapien has no types
    """Import and set up SAPIEN once a process: its settings hold only before anything is made with them."""
    vulkan.prepare()
    try:
        import sapien  # noqa: PLC0415
        import sapien.render  # noqa: PLC0415
    except (ImportError, OSError) as error:
        raise vulkan.RenderingUnavailableError(
            f"the renderer cannot be loaded ({error}); pip install smal[simulator]"
        ) from error
    render = sapien.render
    render.set_log_level("error")
    render.set_global_config(max_num_materials=_MOST_PICTURES, max_num_textures=_MOST_PICTURES)
    # Of the shaders, this one is three times faster on software drivers; shade is part of the ground, see `ground`.
    render.set_camera_shader_dir("minimal")
    render.set_picture_format("Color", "r8g8b8a8unorm")
    return sapien
