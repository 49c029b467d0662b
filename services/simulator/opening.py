"""Make the simulation that settings ask for, for the service and for the Gymnasium environment alike."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Literal

from services.simulator.base import KinematicBase
from services.simulator.sensors import ShakeSettings
from services.simulator.sensors.camera import CameraSettings
from services.simulator.simulation import Simulation
from services.simulator.variation import variation_named
from services.simulator.world import load_world
from services.simulator.world.varying import vary

if TYPE_CHECKING:
    from services.simulator.base import Base
    from services.simulator.world.place import Place, Pose

BaseKind = Literal["physics", "kinematic"]


def open_simulation(
    world: str,
    camera: CameraSettings,
    *,
    base: BaseKind = "physics",
    shake: float | None = None,
    variation: str = "day",
    task: tuple[Pose, Pose] | None = None,
) -> Simulation:
    """Load a world, and put its robot into it.

    Parameters
    ----------
    world
        A name or a path, see `load_world`.
    camera
        The robot's camera; the variation decides about its light.
    base
        `physics`: wheels driven in PhysX. `kinematic`: exact arcs, without mass.
    shake
        Strength of the camera's shake; None for as much as is usual in that world.
    variation
        A name in `VARIATIONS`.
    task
        Start, and where the victim lies; those of the world if not given.

    Raises
    ------
    WorldError
        The world cannot be used.
    RenderingUnavailableError, PhysicsUnavailableError
        This machine lacks what is needed.
    ValueError
        The variation is unknown.
    """
    conditions = variation_named(variation)
    there = load_world(world)
    if task is not None:
        there = replace(there, start=task[0], victim=task[1])
    there = vary(there, facade_seed=conditions.facade_seed, clutter_seed=conditions.clutter_seed)
    return Simulation(
        there,
        replace(camera, light=conditions.light),
        _base(base, there.place),
        shake=None if shake is None else ShakeSettings(shake),
        variation=conditions,
    )


def _base(kind: BaseKind, place: Place) -> Base:
    if kind == "kinematic":
        return KinematicBase(place)
    from services.simulator.physics.physical_base import PhysicalBase  # noqa: PLC0415 - only this needs SAPIEN

    return PhysicalBase(place)
