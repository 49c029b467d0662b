"""Load a world and put its robot into it."""

from dataclasses import replace
from typing import Literal

from services.simulator.base import Base
from services.simulator.sensors.camera import CameraSettings
from services.simulator.simulation import Simulation
from services.simulator.variation import variation_named
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
    variation: str = "day",
    task: tuple[Pose, Pose] | None = None,
    clouds_seed: int | None = None,
    depth: bool = False,
) -> Simulation:
    """Load a world by name or path, and put its robot into it.

    The base `physics` has wheels driven in PhysX, `kinematic` goes along exact arcs, without mass; `car` is
    physics, too, and turns by no less than 1.5 m. `task` is a start
    and where the victim lies, those of the world if not given; `clouds_seed` gives a day of the same light other
    clouds. Without a `depth` camera nothing keeps the robot from running into things. Raises WorldError where the world
    cannot be used, UnavailableError where this machine lacks what is needed, ValueError where the variation is unknown.
    """
    conditions = variation_named(variation)
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
    light = (
        conditions.light
        if clouds_seed is None
        else replace(conditions.light, clouds_seed=clouds_seed)
    )
    return Simulation(
        there, replace(camera, light=light), wheels, shake=shake, variation=conditions, depth=depth
    )
