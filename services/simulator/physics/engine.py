"""The PhysX engine inside SAPIEN: load it, make an empty world with a floor. Needs neither a GPU nor Vulkan."""

from __future__ import annotations

import math
from contextlib import suppress
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final

from services.simulator.scene import vulkan

if TYPE_CHECKING:
    from services.simulator.physics.collision_shapes import TriangleMesh

#: Time that the engine advances by, seconds.
TIMESTEP_S: Final = 1 / 250
#: Bits of a shape's collision group: what it is (first entry), and what it is stopped by (second entry).
FLOOR: Final = 1
OBSTACLE: Final = 2
# A robot's hull glides along a wall, as plastic on plaster does.
_WALL_FRICTION: Final = 0.3
_GRAVITY: Final = (0.0, 0.0, -9.81)


class PhysicsUnavailableError(Exception):
    """The physics engine cannot be loaded on this machine; the message is one line that says what to install."""


@lru_cache(maxsize=1)
def load() -> Any:  # noqa: ANN401 - sapien has no types
    """Return the SAPIEN module.

    Raises
    ------
    PhysicsUnavailableError
        SAPIEN is not installed, or lacks a library.
    """
    # Physics needs no driver, but a renderer may follow in this process, and it wants the choice before this import.
    with suppress(vulkan.RenderingUnavailableError):
        vulkan.prepare()
    try:
        import sapien  # noqa: PLC0415
    except (ImportError, OSError) as error:
        raise PhysicsUnavailableError(
            f"the physics engine cannot be loaded ({error}); pip install -e '.[simulator]'"
        ) from error
    return sapien


def new_scene() -> Any:  # noqa: ANN401 - sapien has no types
    """Return a scene with a level floor at height 0 and gravity.

    PhysX averages the friction of two surfaces. The floor's is 0, so that a wheel's alone decides, and a caster's is
    none; see `friction_against_floor`.
    """
    sapien = load()
    physx = sapien.physx
    # The settings are those of the process, taken by the next system made; an earlier one keeps its own.
    physx.set_scene_config(gravity=_GRAVITY, enable_enhanced_determinism=True, cpu_workers=0)
    system = physx.PhysxCpuSystem()
    system.timestep = TIMESTEP_S
    scene = sapien.Scene([system])
    floor = physx.PhysxCollisionShapePlane(physx.PhysxMaterial(0.0, 0.0, 0.0))
    # A plane faces along its x axis.
    floor.local_pose = sapien.Pose(q=[math.sqrt(0.5), 0.0, -math.sqrt(0.5), 0.0])
    floor.set_collision_groups([FLOOR, 0, 0, 0])
    scene.add_entity(_static([floor]))
    return scene


def friction_against_floor(coefficient: float) -> Any:  # noqa: ANN401 - sapien has no types
    """Return a material that rubs on the floor with a coefficient of friction, at least 0."""
    return load().physx.PhysxMaterial(2 * coefficient, 2 * coefficient, 0.0)


def wall_material() -> Any:  # noqa: ANN401 - sapien has no types
    """Return the material of obstacles, and of whatever runs into them; nothing bounces."""
    return load().physx.PhysxMaterial(_WALL_FRICTION, _WALL_FRICTION, 0.0)


def obstacle_entity(mesh: TriangleMesh) -> Any:  # noqa: ANN401 - sapien has no types
    """Return immovable obstacles, cooked once; the entity can be moved from scene to scene. An empty mesh is none."""
    if not len(mesh.triangles):
        return _static([])
    physx = load().physx
    shape = physx.PhysxCollisionShapeTriangleMesh(mesh.vertices, mesh.triangles, [1.0, 1.0, 1.0], wall_material())
    shape.set_collision_groups([OBSTACLE, 0, 0, 0])
    return _static([shape])


def _static(shapes: list[Any]) -> Any:  # noqa: ANN401 - sapien has no types
    sapien = load()
    body = sapien.physx.PhysxRigidStaticComponent()
    for shape in shapes:
        body.attach(shape)
    entity = sapien.Entity()
    entity.add_component(body)
    return entity
