"""The PhysX engine inside SAPIEN, on the CPU: a floor, and obstacles on it. Needs neither a GPU nor Vulkan."""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import lru_cache
from typing import Any, Final

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from services.simulator.scene.meshes import outline, quads, sides
from services.simulator.scene.vulkan import load_sapien
from services.simulator.world.place import Solid

# A line stands for something thin: a fence, a hedge, the edge of the world.
_HALF_THICKNESS_M: Final = 0.01
# Walls end so far above a robot's top, where it never meets their upper edge.
_ABOVE_M: Final = 1.0
# PhysX warns of triangles that are much larger than what touches them.
_LONGEST_WALL_M: Final = 20.0
#: Time that the engine advances by, seconds.
TIMESTEP_S: Final = 1 / 250
#: Bits of a shape's collision group: what it is (first entry), and what it is stopped by (second entry).
FLOOR: Final = 1
OBSTACLE: Final = 2
# A robot's hull glides along a wall, as plastic on plaster does.
_WALL_FRICTION: Final = 0.3
_GRAVITY: Final = (0.0, 0.0, -9.81)


@lru_cache(maxsize=1)
def load() -> Any:
    """Return the SAPIEN module; an `UnavailableError` where it is not installed or lacks a library."""
    return load_sapien(rendering=False)


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


def obstacles(solids: Iterable[Solid], under_m: float) -> Any:
    """Return the walls of solids as an immovable entity, cooked once, that can be moved from scene to scene.

    Nothing flies here: what begins at the robot's height `under_m` or above is driven under, and left out; walls end a
    metre above the robot. Lines are given a thickness of 2 cm.
    """
    walls = [
        sides(ring, solid.low_m, min(solid.high_m, under_m + _ABOVE_M))
        for solid in solids
        if solid.low_m < under_m
        for ring in _rings(solid.shape)
    ]
    if not walls:
        return _static([])
    corners = np.concatenate(walls)
    mesh = quads(corners, np.zeros((len(corners), 4, 2)))
    physx = load().physx
    shape = physx.PhysxCollisionShapeTriangleMesh(mesh.vertices, mesh.triangles, [1.0, 1.0, 1.0], wall_material())
    shape.set_collision_groups([OBSTACLE, 0, 0, 0])
    return _static([shape])


def _rings(shape: BaseGeometry) -> list[NDArray[np.float64]]:
    """Return the closed outlines (k, 2) of all that a shape covers, each with the solid on its left."""
    parts = [
        part if part.geom_type == "Polygon" else part.buffer(_HALF_THICKNESS_M, cap_style="square", join_style="mitre")
        for part in shapely.get_parts(shape)
    ]
    polygons = shapely.segmentize(shapely.get_parts(parts), _LONGEST_WALL_M)
    return [ring for polygon in polygons for ring in outline(polygon)]


def _static(shapes: list[Any]) -> Any:
    sapien = load()
    body = sapien.physx.PhysxRigidStaticComponent()
    for shape in shapes:
        body.attach(shape)
    entity = sapien.Entity()
    entity.add_component(body)
    return entity
