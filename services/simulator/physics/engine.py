"""The PhysX engine inside SAPIEN, on the CPU: a floor, and obstacles on it. Needs neither a GPU nor Vulkan."""

from __future__ import annotations

import math
from collections.abc import Iterable
from contextlib import suppress
from functools import lru_cache
from typing import Any, Final, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from services.simulator.scene import vulkan
from services.simulator.scene.meshes import outline, sides
from services.simulator.world.place import Solid

# A line stands for something thin: a fence, a hedge, the edge of the world.
_HALF_THICKNESS_M: Final = 0.01
# Walls end so far above a robot's top, where it never meets their upper edge.
_ABOVE_M: Final = 1.0
# PhysX warns of triangles that are much larger than what touches them.
_LONGEST_WALL_M: Final = 20.0
_HULL_SIDES: Final = 32
#: Time that the engine advances by, seconds.
TIMESTEP_S: Final = 1 / 250
#: Bits of a shape's collision group: what it is (first entry), and what it is stopped by (second entry).
FLOOR: Final = 1
OBSTACLE: Final = 2
# A robot's hull glides along a wall, as plastic on plaster does.
_WALL_FRICTION: Final = 0.3
_GRAVITY: Final = (0.0, 0.0, -9.81)


class TriangleMesh(NamedTuple):
    """Triangles that face the side from which their corners run anticlockwise: (m, 3) rows of (n, 3) vertices."""

    vertices: NDArray[np.float32]
    triangles: NDArray[np.uint32]


def upright_sides(solids: Iterable[Solid], under_m: float) -> TriangleMesh:
    """Return the outer and courtyard walls of solids, facing away from them, up to a metre above the robot.

    Nothing flies here: what begins at the robot's height `under_m` or above is driven under, and left out. Lines are
    given a thickness of 2 cm. Without any solid the mesh is empty.
    """
    walls = [
        sides(ring, solid.low_m, min(solid.high_m, under_m + _ABOVE_M))
        for solid in solids
        if solid.low_m < under_m
        for ring in _rings(solid.shape)
    ]
    corners = np.concatenate([np.empty((0, 4, 3)), *walls])
    quads = np.arange(4 * len(corners)).reshape(-1, 4)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return TriangleMesh(corners.reshape(-1, 3).astype(np.float32), triangles.astype(np.uint32))


def hull(radius_m: float, low_m: float, high_m: float) -> NDArray[np.float32]:
    """Return the corners (n, 3) of an upright prism about the z axis that lies within a cylinder, 0.5 % smaller."""
    angles = np.arange(_HULL_SIDES) * math.tau / _HULL_SIDES
    ring = radius_m * np.column_stack([np.cos(angles), np.sin(angles)])
    ends = [np.column_stack([ring, np.full(_HULL_SIDES, height)]) for height in (low_m, high_m)]
    return np.concatenate(ends).astype(np.float32)


def _rings(shape: BaseGeometry) -> list[NDArray[np.float64]]:
    """Return the closed outlines (k, 2) of all that a shape covers, each with the solid on its left."""
    parts = [
        part if part.geom_type == "Polygon" else part.buffer(_HALF_THICKNESS_M, cap_style="square", join_style="mitre")
        for part in shapely.get_parts(shape)
    ]
    polygons = shapely.segmentize(shapely.get_parts(parts), _LONGEST_WALL_M)
    return [ring for polygon in polygons for ring in outline(polygon)]


class PhysicsUnavailableError(Exception):
    """The physics engine cannot be loaded on this machine; the message is one line that says what to install."""


@lru_cache(maxsize=1)
def load() -> Any:
    """Return the SAPIEN module, or raise `PhysicsUnavailableError` where it is not installed or lacks a library."""
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


def new_scene() -> Any:
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


def friction_against_floor(coefficient: float) -> Any:
    """Return a material that rubs on the floor with a coefficient of friction, at least 0."""
    return load().physx.PhysxMaterial(2 * coefficient, 2 * coefficient, 0.0)


def wall_material() -> Any:
    """Return the material of obstacles, and of whatever runs into them; nothing bounces."""
    return load().physx.PhysxMaterial(_WALL_FRICTION, _WALL_FRICTION, 0.0)


def obstacle_entity(mesh: TriangleMesh) -> Any:
    """Return immovable obstacles, cooked once; the entity can be moved from scene to scene. An empty mesh is none."""
    if not len(mesh.triangles):
        return _static([])
    physx = load().physx
    shape = physx.PhysxCollisionShapeTriangleMesh(mesh.vertices, mesh.triangles, [1.0, 1.0, 1.0], wall_material())
    shape.set_collision_groups([OBSTACLE, 0, 0, 0])
    return _static([shape])


def _static(shapes: list[Any]) -> Any:
    sapien = load()
    body = sapien.physx.PhysxRigidStaticComponent()
    for shape in shapes:
        body.attach(shape)
    entity = sapien.Entity()
    entity.add_component(body)
    return entity
