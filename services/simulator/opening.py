"""Load a world and put its robot into it."""

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
    """Load a world by name or path, and put its robot into it.

    The base `physics` has wheels driven in PhysX; `kinematic` goes along exact arcs, without mass; `car` is physics,
    too, and its minimum turning radius is 1.5 m. `task` is a start and where the victim lies, by default those of the
    world. Without a `depth` camera nothing keeps the robot from driving into things.

    Raises
    ------
    WorldError
        The world cannot be used.
    UnavailableError
        This machine lacks what is needed.
    ValueError
        The variation is unknown.
    """
    conditions = variation_named(variation) if isinstance(variation, str) else variation
    there = load_foreign_world(world)
    if task is not None:
        there = replace(there, start=task[0], victim=task[1])
    there = vary(there, facade_seed=conditions.facade_seed, clutter_seed=conditions.clutter_seed)
    wheels: Base | None = None
    if base == "car":
        there = replace(there, drive=there.robot.drive.car)
    if base != "kinematic":
        from services.simulator.physics import PhysicalBase  # noqa: PLC0415 - only this needs SAPIEN

        wheels = PhysicalBase(there.place, there.robot.drive)
    camera = replace(camera, light=conditions.light)
    return Simulation(there, camera, wheels, shake=shake, variation=conditions, depth=depth)
