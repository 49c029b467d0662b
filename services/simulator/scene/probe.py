"""Render one tiny frame and say with what: ``python -m services.simulator.scene.probe``.

A process of its own, because a broken graphics driver takes its process with it.
"""

from __future__ import annotations

import json
import sys
import time

from services.simulator.scene import vulkan

_SOFTWARE_DRIVERS = ("llvmpipe", "lavapipe", "swiftshader")


def render_red_box() -> tuple[str, tuple[int, int, int]]:
    """Render a red box seen from three metres.

    Returns
    -------
    driver, colour
        Name of the graphics device, and red, green, blue (0 to 255) of the pixel in the middle.

    Raises
    ------
    RenderingUnavailableError
        The renderer, the Vulkan loader or a driver is missing or does not work.
    """
    sapien = vulkan.load_sapien()
    try:
        sapien.render.set_log_level("error")
        # Others of SAPIEN's first make a table of reflections: six seconds of processor time without a GPU.
        sapien.render.set_camera_shader_dir("trivial")
        scene = sapien.Scene()
        scene.set_ambient_light([1.0, 1.0, 1.0])
        builder = scene.create_actor_builder()
        builder.add_box_visual(half_size=[0.5, 0.5, 0.5], material=[1.0, 0.0, 0.0])
        builder.build_static()
        camera = scene.add_camera("probe", 64, 48, 1.0, 0.1, 100.0)
        camera.set_local_pose(sapien.Pose([-3.0, 0.0, 0.0]))
        scene.update_render()
        camera.take_picture()
        red, green, blue = (round(255 * float(c)) for c in camera.get_picture("Color")[24, 32, :3])
    except RuntimeError as error:
        raise vulkan.RenderingUnavailableError(
            f"the Vulkan driver cannot render ({error}); {vulkan.INSTALL}"
        ) from error
    return scene.render_system.device.name, (red, green, blue)


def main() -> int:
    """Print one JSON object: driver, software, seconds; or error."""
    begin_s = time.monotonic()
    try:
        driver, (red, green, blue) = render_red_box()
    except vulkan.RenderingUnavailableError as error:
        return _answer(1, {"error": " ".join(str(error).split())})
    if not red > 2 * max(green, blue):
        return _answer(1, {"error": f"{driver} renders a red box as ({red}, {green}, {blue}); {vulkan.INSTALL}"})
    software = any(name in driver.lower() for name in _SOFTWARE_DRIVERS)
    return _answer(0, {"driver": driver, "software": software, "seconds": round(time.monotonic() - begin_s, 1)})


def _answer(status: int, answer: dict[str, str | bool | float]) -> int:
    sys.stdout.write(f"\n{json.dumps(answer)}\n")
    return status


if __name__ == "__main__":
    sys.exit(main())
