"""Render a tiny frame in a separate process, in case the driver crashes; print JSON."""

import json
import sys
import time

from services.simulator.scene.vulkan import INSTALL, UnavailableError, cannot_render, load_sapien

_SOFTWARE_DRIVERS = ("llvmpipe", "lavapipe", "swiftshader")


def probed() -> dict[str, str | bool | float]:
    """Render a red box from 3 m, and check the middle pixel."""
    begin_s = time.monotonic()
    try:
        sapien = load_sapien()
        sapien.render.set_log_level("error")
        # SAPIEN's other shaders first compute a reflection table: 6 s of processor time without a
        # GPU.
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
        red, green, blue = (
            round(255 * float(level)) for level in camera.get_picture("Color")[24, 32, :3]
        )
    except UnavailableError as error:
        return {"error": " ".join(str(error).split())}
    except RuntimeError as error:
        return {"error": " ".join(str(cannot_render(error)).split())}
    driver = scene.render_system.device.name
    if not red > 2 * max(green, blue):
        return {"error": f"{driver} renders a red box as ({red}, {green}, {blue}); {INSTALL}"}
    software = any(name in driver.lower() for name in _SOFTWARE_DRIVERS)
    return {"driver": driver, "software": software, "seconds": round(time.monotonic() - begin_s, 1)}


if __name__ == "__main__":
    answer = probed()
    sys.stdout.write(f"\n{json.dumps(answer)}\n")
    sys.exit("error" in answer)
