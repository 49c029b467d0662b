"""What SAPIEN draws: lights, bodies made of surfaces, and which of them are shown."""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from services.simulator.scene import vulkan

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from services.simulator.scene.surfaces import Lights, Surface, Vector

_MOST_PICTURES: Final = 2048
_SHADER: Final = Path(__file__).parent / "shader"
_LIGHTS: Final = 3


class Stage:
    """An empty scene of SAPIEN's with lights, to which bodies and cameras are added.

    Attributes
    ----------
    sapien
        The renderer's package.
    scene
        Its scene.
    shown
        Numbers of the curtains that are drawn, in that order.
    """

    def __init__(self, lights: Lights) -> None:
        self.sapien = load_renderer()
        self.scene = self.sapien.Scene([self.sapien.render.RenderSystem()])
        self.scene.set_ambient_light(lights.ambient)
        for direction, colour in _filled(lights):
            self.scene.add_directional_light(direction, colour, shadow=False)
        self.shown: list[int] = []
        self._curtains: list[Any] = []
        self._materials: dict[tuple[int, int], Any] = {}

    def add(self, surfaces: Iterable[Surface], label: int) -> Any:  # noqa: ANN401 - sapien has no types
        """Add one entity of all the surfaces, whose pixels carry `label`; it is drawn from now on."""
        render = self.sapien.render
        body = render.RenderBodyComponent()
        for surface in surfaces:
            mesh, key = surface.mesh, (id(surface.picture), label)
            if key not in self._materials:
                self._materials[key] = _material(render, surface, label)
            material = self._materials[key]
            body.attach(render.RenderShapeTriangleMesh(mesh.vertices, mesh.triangles, mesh.normals, mesh.uvs, material))
        return self.entity(body)

    def entity(self, component: Any) -> Any:  # noqa: ANN401 - see above
        """Add an entity of one component."""
        entity = self.sapien.Entity()
        entity.add_component(component)
        self.scene.add_entity(entity)
        return entity

    def hang(self, entity: Any) -> int:  # noqa: ANN401 - see above
        """Take an entity out until it is shown; return its number as a curtain."""
        curtain = entity.find_component_by_type(self.sapien.render.RenderBodyComponent)
        curtain.disable()
        self._curtains.append(curtain)
        return len(self._curtains) - 1

    def show(self, wanted: Sequence[int]) -> None:
        """Have these curtains drawn, in this order; what is drawn first hides the others.

        All are taken out and put back, so that a picture depends on nothing that was drawn before.
        """
        if list(wanted) == self.shown:
            return
        for number in self.shown:
            self._curtains[number].disable()
        for number in wanted:
            self._curtains[number].enable()
        self.shown = list(wanted)


@lru_cache(maxsize=1)
def load_renderer() -> Any:  # noqa: ANN401 - sapien has no types
    """Import and set up SAPIEN once a process: its settings hold only before anything is made with them.

    Raises
    ------
    RenderingUnavailableError
        SAPIEN or a Vulkan driver is missing.
    """
    sapien = vulkan.load_sapien()
    render = sapien.render
    render.set_log_level("error")
    render.set_global_config(max_num_materials=_MOST_PICTURES, max_num_textures=_MOST_PICTURES)
    # A third of the time of SAPIEN's quickest one on software drivers; shade is part of the ground, see `ground`.
    render.set_camera_shader_dir(str(_SHADER))
    render.set_picture_format("Color", "r8g8b8a8unorm")
    return sapien


def _filled(lights: Lights) -> list[tuple[Vector, Vector]]:
    """Return directions and colours of as many lights as the shader has, the rest of them dark."""
    dark = [((0.0, 0.0, -1.0), (0.0, 0.0, 0.0))] * (_LIGHTS - len(lights.directional))
    return [*lights.directional, *dark]


def _material(render: Any, surface: Surface, label: int) -> Any:  # noqa: ANN401 - sapien has no types
    height, width, _ = surface.picture.shape
    opaque = np.dstack([surface.picture, np.full((height, width), 255, dtype=np.uint8)])
    levels = int(math.log2(max(height, width))) + 1
    texture = render.RenderTexture2D(opaque, "R8G8B8A8Unorm", levels, "linear", "repeat", srgb=False)
    material = render.RenderMaterial(base_color=[0.0, 0.0, 0.0, 1.0], specular=0.0, roughness=label / 255, metallic=0.0)
    if surface.glows:
        material.set_emission_texture(texture)
    else:
        material.set_base_color_texture(texture)
    return material
