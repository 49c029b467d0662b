"""The trivial scene by one of SAPIEN's own shaders: ``python -m tests.benchmarks.rendering.stock SHADER W H FRAMES``.

A process of its own, because SAPIEN's shader and formats are set once a process. The meshes, pictures and poses are
those of the benchmark; only the shader is SAPIEN's, with its light and its formats. Prints the times of the frames in
milliseconds as JSON.
"""

from __future__ import annotations

import json
import math
import sys
import time
from typing import Any

import numpy as np

from services.simulator.scene import vulkan
from services.simulator.scene.build import build_scene
from services.simulator.sensors.camera import CameraSettings
from tests.benchmarks.rendering.towns import field


def times_ms(shader: str, size: tuple[int, int], frames: int) -> list[float]:
    """Return the time of frames of the trivial scene, after one that is not counted."""
    sapien = vulkan.load_sapien()
    sapien.render.set_log_level("error")
    sapien.render.set_camera_shader_dir(shader)
    scene = sapien.Scene([sapien.render.RenderSystem()])
    _fill(sapien, scene)
    camera = sapien.render.RenderCameraComponent(*size)
    focal = size[0] / 2 / math.tan(math.radians(CameraSettings(*size).field_of_view_deg) / 2)
    camera.set_perspective_parameters(0.1, 2000.0, focal, focal, size[0] / 2, size[1] / 2, 0.0)
    mast = sapien.Entity()
    mast.add_component(camera)
    scene.add_entity(mast)
    found = []
    for number in range(frames + 1):
        angle = math.tau * number / 12
        began_s = time.perf_counter()
        turn = (math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2))
        mast.set_pose(sapien.Pose((-20 * math.cos(angle), -20 * math.sin(angle), 1.2), turn))
        scene.update_render()
        camera.take_picture()
        np.asarray(camera.get_picture("Color"))
        found.append(1e3 * (time.perf_counter() - began_s))
    return found[1:]


def _fill(sapien: Any, scene: Any) -> None:
    world = field()
    built = build_scene(world, CameraSettings(64, 48).light, shadows=True)
    scene.set_ambient_light([0.5, 0.5, 0.5])
    for direction, colour in built.lights.directional:
        scene.add_directional_light(direction, colour, shadow=False)
    body = sapien.render.RenderBodyComponent()
    for surface in (*built.still, *built.victim, *([] if built.sky is None else [built.sky])):
        opaque = np.dstack([surface.picture, np.full(surface.picture.shape[:2], 255, dtype=np.uint8)])
        levels = int(math.log2(max(opaque.shape))) + 1
        material = sapien.render.RenderMaterial(base_color=[0.0, 0.0, 0.0, 1.0], specular=0.0, roughness=1.0)
        picture = sapien.render.RenderTexture2D(opaque, "R8G8B8A8Unorm", levels, "linear", "repeat", srgb=False)
        (material.set_emission_texture if surface.glows else material.set_base_color_texture)(picture)
        mesh = surface.mesh
        body.attach(
            sapien.render.RenderShapeTriangleMesh(mesh.vertices, mesh.triangles, mesh.normals, mesh.uvs, material)
        )
    entity = sapien.Entity()
    entity.add_component(body)
    scene.add_entity(entity)


if __name__ == "__main__":
    shader, width, height, frames = sys.argv[1:]
    sys.stdout.write(f"\n{json.dumps(times_ms(shader, (int(width), int(height)), int(frames)))}\n")
