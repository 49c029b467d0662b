"""The robot's camera and the overhead camera, rendered by SAPIEN."""

import math
from collections.abc import Sequence
from functools import lru_cache
from itertools import zip_longest
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from services.kit.going_on import each
from services.simulator.scene.bodies import body
from services.simulator.scene.build import build_scene
from services.simulator.scene.furniture import furnish
from services.simulator.scene.surfaces import Surface, Tile, surfaces
from services.simulator.scene.tiles import ShownTiles
from services.simulator.scene.vulkan import cannot_render, load_sapien
from services.simulator.sensors.camera import FOCAL, CameraSettings
from services.simulator.sensors.readings import LEVEL, Tilt
from services.simulator.world.obstacles import Obstacle
from services.simulator.world.place import OverheadMount, Pose, World

_MOST_PICTURES: Final = 2048
_SHADER: Final = Path(__file__).parent / "shader"
# Number of lights in the shader; unused lights are dark.
_LIGHTS: Final = 3
_DARK: Final = ((0.0, 0.0, -1.0), (0.0, 0.0, 0.0))
_NEAR_M: Final = 0.1
_FAR_M: Final = 2000.0
#: Labels of pixels in the alpha channel, 0 to 255; our shader takes them from the material. Colours
#: are blended with earlier draws by alpha, so labels are near 255, and the victim and the robot are
#: drawn first.
NOTHING: Final = 0
STILL: Final = 255
SKY: Final = 254
VICTIM: Final = 253
ROBOT: Final = 252


@lru_cache(maxsize=1)
def load_renderer() -> Any:
    """Import and configure SAPIEN once; its settings apply only before other calls."""
    sapien = load_sapien()
    render = sapien.render
    render.set_log_level("error")
    render.set_global_config(max_num_materials=_MOST_PICTURES, max_num_textures=_MOST_PICTURES)
    # Takes a third of the time of SAPIEN's fastest shader on software drivers; `ground` draws
    # shadows.
    render.set_camera_shader_dir(str(_SHADER))
    render.set_picture_format("Color", "r8g8b8a8unorm")
    return sapien


class SceneCamera:
    """A camera on the robot's mast in a world; raises UnavailableError without Vulkan."""

    def __init__(self, world: World, settings: CameraSettings) -> None:
        self._sapien = sapien = load_renderer()
        self._ahead_m = world.robot.camera.ahead_m
        self._height_m = world.robot.camera.height_m + settings.raised_m
        self._pitch_rad = math.radians(settings.pitch_deg)
        above = world.place.overhead
        #: Focal length in pixels of the image.
        self.focal_px = settings.zoom * settings.width * FOCAL
        self._seen_from: tuple[Pose, Tilt] | None = None
        scene = build_scene(world, settings.light)
        try:
            self._scene = sapien.Scene([sapien.render.RenderSystem()])
            self._scene.set_ambient_light(scene.ambient)
            for direction, colour in (*scene.lights, *[_DARK] * (_LIGHTS - len(scene.lights))):
                self._scene.add_directional_light(direction, colour, shadow=False)
            # Draw order: early draws occlude later draws; the sky is last, and moves with the
            # camera.
            self._victim = self._add(self._body(scene.victim, VICTIM))
            self._decoys = [self._add(self._body(decoy, STILL)) for decoy in scene.decoys]
            self._robot = self._add(self._body(scene.robot, ROBOT))
            self._obstacles: list[Any] = []
            self._people: list[Any] = []
            self._walk: Sequence[Pose] = ()
            if scene.still:
                self._add(self._body(scene.still, STILL))
            self._tiles = self._add_tiles(scene.tiles)
            self._sky = None if scene.sky is None else self._add(self._body([scene.sky], SKY))
            self._camera = self._lens(settings.width, settings.height, self.focal_px)
            self._mast = self._add(self._camera)
            self._above = None if above is None else self._look_down(above)
            self.lay(world.victim)
        except RuntimeError as error:
            raise cannot_render(error) from error

    def lay(self, victim: Pose | None, decoy: Pose | None = None, which: int = 0) -> None:
        """Place the victim, and a decoy in its place; None hides either."""
        places = [victim, *([None] * len(self._decoys))]
        places[1 + which % len(self._decoys)] = decoy
        for entity, at in zip((self._victim, *self._decoys), places, strict=True):
            self._move(entity, at)

    def obstruct(self, things: Sequence[Obstacle]) -> None:
        """Replace the displayed obstacles."""
        self._seen_from = None
        for entity in self._obstacles:
            self._scene.remove_entity(entity)
        self._obstacles = [
            self._add(self._body(surfaces(furnish(one.piece)), STILL)) for one in things
        ]
        for entity, one in zip(self._obstacles, things, strict=True):
            self._move(entity, one.pose)

    def walk(self, people: Sequence[Pose]) -> None:
        """Move the displayed people to poses."""
        if people == self._walk:
            return
        self._walk = people
        while len(self._people) < len(people):
            self._people.append(self._add(self._body(surfaces(body("walker")), STILL)))
        for entity, at in zip_longest(self._people, people):
            self._move(entity, at)

    def _move(self, entity: Any, at: Pose | None) -> None:
        """Move an entity to a pose; None hides it under the ground."""
        at_m = (0.0, 0.0, -_FAR_M) if at is None else (at.x, at.y, 0.0)
        entity.set_pose(self._sapien.Pose(at_m, _turn(0.0 if at is None else at.heading)))
        self._seen_from = None

    def render(self, pose: Pose, tilt: Tilt = LEVEL) -> NDArray[np.uint8]:
        """Render the image of a tilted camera at `pose`, (height, width, 3) uint8 RGB."""
        self._look_from(pose, tilt)
        return _colour(self._camera)

    def depth_m(self, pose: Pose, tilt: Tilt = LEVEL) -> NDArray[np.float32]:
        """Render the depth along the axis, (height, width) float32, metres; `inf` for the sky."""
        shown = self._labels(pose, tilt)
        # The depth buffer is 0 at the near plane, 1 at the far plane, and linear in the inverse
        # depth.
        buffer = self._camera.get_picture("GbufferDepth").astype(np.float64)
        depth = _NEAR_M * _FAR_M / (_FAR_M - buffer * (_FAR_M - _NEAR_M))
        return np.where((shown == NOTHING) | (shown == SKY), np.inf, depth).astype(np.float32)

    def victim_pixels(self, pose: Pose, tilt: Tilt = LEVEL) -> float:
        """Return the fraction of the image, 0 to 1, that the victim fills."""
        return float(np.mean(self._labels(pose, tilt) == VICTIM))

    def overhead(self, pose: Pose) -> NDArray[np.uint8]:
        """Render the overhead image of a robot at `pose`; raises LookupError without a camera."""
        if self._above is None:
            raise LookupError("this place has no overhead camera")
        self._put_robot(pose)
        self._tiles.show_all()
        self._scene.update_render()
        self._above.take_picture()
        # The scene no longer matches the image of the robot's own camera.
        self._seen_from = None
        return _colour(self._above)

    def _labels(self, pose: Pose, tilt: Tilt) -> NDArray[np.uint8]:
        """Return the label of each pixel: `NOTHING`, `SKY`, `STILL`, `VICTIM` or `ROBOT`."""
        self._look_from(pose, tilt)
        return np.asarray(self._camera.get_picture("Color")[..., 3])

    def _look_from(self, pose: Pose, tilt: Tilt) -> None:
        if (pose, tilt) == self._seen_from:
            return
        self._put_robot(pose)
        at = (*pose.at(self._ahead_m), self._height_m)
        self._tiles.show_from(Pose(at[0], at[1], pose.heading))
        pitched = tilt._replace(pitch=tilt.pitch + self._pitch_rad)
        mast = self._sapien.Pose(at, _turn(pose.heading, pitched))
        self._mast.set_pose(mast)
        if self._sky is not None:
            self._sky.set_pose(self._sapien.Pose(mast.p))
        self._scene.update_render()
        self._camera.take_picture()
        self._seen_from = pose, tilt

    def _add_tiles(self, tiles: Sequence[Tile]) -> ShownTiles:
        textures: dict[int, Any] = {}
        bodies = []
        for tile in each(tiles):
            near, far = (self._body([one], STILL, textures) for one in (tile.near, tile.far))
            self._add(near)
            self._add(far)
            bodies.append((near, far))
        return ShownTiles(tiles, bodies)

    def _put_robot(self, pose: Pose) -> None:
        self._robot.set_pose(self._sapien.Pose((pose.x, pose.y, 0.0), _turn(pose.heading)))

    def _body(
        self, surfaces: Sequence[Surface], label: int, textures: dict[int, Any] | None = None
    ) -> Any:
        """Build a body of the surfaces with a pixel `label`; `textures` are shared by picture."""
        render = self._sapien.render
        known = {} if textures is None else textures
        materials = dict[tuple[object, ...], Any]()
        body = render.RenderBodyComponent()
        for surface in each(surfaces):
            mesh = surface.mesh
            picture = id(surface.picture)
            if picture not in known:
                known[picture] = _texture(render, surface.picture)
            key = picture, surface.glows, surface.tint
            if key not in materials:
                materials[key] = _material(render, known[picture], surface, label)
            arrays = mesh.vertices, mesh.triangles, mesh.normals, mesh.uvs
            body.attach(render.RenderShapeTriangleMesh(*arrays, materials[key]))
        return body

    def _add(self, component: Any) -> Any:
        entity = self._sapien.Entity()
        entity.add_component(component)
        self._scene.add_entity(entity)
        return entity

    def _look_down(self, mount: OverheadMount) -> Any:
        camera = self._lens(mount.width_px, mount.height_px, mount.focal_px)
        cos = math.cos(math.radians(mount.up_deg))
        sin = math.sin(math.radians(mount.up_deg))
        # Columns: axes ahead, to the left and up, and position.
        frame = np.eye(4)
        frame[:3, :3] = np.transpose([(0.0, 0.0, -1.0), (-sin, cos, 0.0), (cos, sin, 0.0)])
        frame[:3, 3] = mount.x_m, mount.y_m, mount.height_m
        self._add(camera).set_pose(self._sapien.Pose(frame))
        return camera

    def _lens(self, width: int, height: int, focal_px: float) -> Any:
        camera = self._sapien.render.RenderCameraComponent(width, height)
        camera.set_perspective_parameters(
            _NEAR_M, _FAR_M, focal_px, focal_px, width / 2, height / 2, 0.0
        )
        return camera


def _texture(render: Any, picture: NDArray[np.uint8]) -> Any:
    height, width, _ = picture.shape
    opaque = np.dstack([picture, np.full((height, width), 255, dtype=np.uint8)])
    levels = int(math.log2(max(height, width))) + 1
    return render.RenderTexture2D(opaque, "R8G8B8A8Unorm", levels, "linear", "repeat", srgb=False)


def _material(render: Any, texture: Any, surface: Surface, label: int) -> Any:
    material = render.RenderMaterial(
        base_color=[0.0, 0.0, 0.0, 1.0], specular=0.0, roughness=label / 255, metallic=0.0,
        emission=[*surface.tint, 1.0],
    )  # fmt: skip
    if surface.glows:
        material.set_emission_texture(texture)
    else:
        material.set_base_color_texture(texture)
    return material


def _turn(heading: float, tilt: Tilt = LEVEL) -> NDArray[np.float64]:
    """Return heading and tilt as a unit quaternion (w, x, y, z)."""
    turn = Rotation.from_euler("ZYX", [heading + tilt.yaw, tilt.pitch, tilt.roll])
    return np.asarray(turn.as_quat(scalar_first=True))


def _colour(camera: Any) -> NDArray[np.uint8]:
    return np.asarray(cv2.cvtColor(camera.get_picture("Color"), cv2.COLOR_RGBA2RGB), dtype=np.uint8)
