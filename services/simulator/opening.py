"""Open a world by name or path with a robot in it."""

from dataclasses import replace
from typing import Literal

from services.simulator.base import Base
from services.simulator.sensors.camera import CameraSettings
from services.simulator.simulation import Simulation
from services.simulator.variation import Variation, variation_named
from services.simulator.world import load_foreign_world
from services.simulator.world.place import Pose
from services.simulator.world.varying import vary

BaseKind = Literal["physics", "kinematic", "car"]


def open_simulation(
    world: str,
    camera: CameraSettings,
    *,
    base: BaseKind = "physics",
    shake: float | None = None,
    variation: str | Variation = "day",
    task: tuple[Pose, Pose] | None = None,
    depth: bool = False,
) -> Simulation:
    """Open a world by name or path with its robot.

    Parameters
    ----------
    world : str
        Name of an included world, or path of a world file or map.
    camera : CameraSettings
        Image size in pixels.
    base : {"physics", "kinematic", "car"}
        Wheels in PhysX; exact arcs without mass; or PhysX with a minimum turning radius of 1.5 m.
    shake : float, optional
        Factor of the camera shake; by default the place's own.
    variation : str or Variation
        Conditions such as light and haze.
    task : tuple of Pose, optional
        Start and victim; by default the world's own.
    depth : bool
        Whether the robot has a depth camera. Without one it does not avoid obstacles.

    Raises
    ------
    WorldError
        The world is unusable.
    UnavailableError
        A driver or SAPIEN is missing on this machine.
    ValueError
        The variation is unknown.
    """
    conditions = variation_named(variation) if isinstance(variation, str) else variation
    opened = load_foreign_world(world)
    if task is not None:
        opened = replace(opened, start=task[0], victim=task[1])
    opened = vary(opened, facade_seed=conditions.facade_seed, clutter_seed=conditions.clutter_seed)
    wheels: Base | None = None
    if base == "car":
        opened = replace(opened, drive=opened.robot.drive.car)
    if base != "kinematic":
        from services.simulator.physics import PhysicalBase  # noqa: PLC0415 - only this needs SAPIEN

        wheels = PhysicalBase(opened.place, opened.robot.drive)
    camera = replace(camera, light=conditions.light)
    return Simulation(opened, camera, wheels, shake=shake, variation=conditions, depth=depth)
