"""The robot as an articulation: a round hull on two driven wheels and two casters."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

from services.simulator.physics.collision_shapes import hull
from services.simulator.physics.engine import FLOOR, OBSTACLE, friction_against_floor, load, wall_material

if TYPE_CHECKING:
    from services.simulator.robots import Drive, RobotModel
    from services.simulator.world.place import Pose

#: Rubber on dry asphalt or a clean floor.
_TYRE_FRICTION: Final = 1.1
# The motors' torque, as the acceleration that it gives to the robot: more than the tyres carry, so that a robot at a
# wall spins its wheels.
_TORQUE_M_S2: Final = 12.0
# The wheels near their commanded speed with this time constant, unless torque or friction limit them.
_RESPONSE_S: Final = 0.01
_WHEEL_MASS: Final = 0.04  # of the robot's, each
_CASTER_AT: Final = 0.8  # of the robot's radius, ahead and behind
_CASTER_RADIUS_M: Final = 0.02
# Four wheels that all touch would take weight off the driven ones as chance has it. The rear caster carries, the
# front one hangs this high and catches the robot when it brakes.
_FRONT_CASTER_M: Final = 0.005
_CENTRE_BEHIND: Final = 0.1  # of the way to the rear caster: so much of the weight the caster carries
_CENTRE_HEIGHT: Final = 0.25  # of the body's height: batteries lie low
_GROUND_CLEARANCE_M: Final = 0.02
_MAST_HALF_WIDTH_M: Final = 0.02
# More make the drive's steady state truer: with 4 the robot is 0.2 % slow and creeps by 0.5 mm/s at rest.
_SOLVER_ITERATIONS: Final = 16
# Joints turn about their x axis; this turns it to the robot's left.
_AXLE: Final = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))


def add_robot(scene: Any, robot: RobotModel, drive: Drive, pose: Pose) -> Any:  # noqa: ANN401
    """Put a robot into a scene, at rest, and return its articulation.

    The root is the chassis, its origin the middle of the wheels' axis, x ahead. The two joints are the left and the
    right wheel, positive forwards.

    Parameters
    ----------
    robot
        The body.
    drive
        The wheels.
    pose
        Where it stands.
    """
    sapien = load()
    chassis = _chassis(sapien, robot, drive.wheel_radius_m)
    wheels = [_wheel(sapien, chassis, robot.mass_kg, drive, side) for side in (1.0, -1.0)]
    turn = (math.cos(pose.heading / 2), 0.0, 0.0, math.sin(pose.heading / 2))
    for link in (chassis, *wheels):
        entity = sapien.Entity()
        entity.add_component(link)
        scene.add_entity(entity)
    articulation = chassis.articulation
    articulation.root_pose = sapien.Pose([pose.x, pose.y, drive.wheel_radius_m], turn)
    articulation.solver_position_iterations = _SOLVER_ITERATIONS
    # When it sleeps is for its driver to say: the engine may take seconds, or do it in the middle of slow driving.
    articulation.sleep_threshold = 0.0
    for link in (chassis, *wheels):
        # The engine's default slows everything that moves, as if in oil.
        link.linear_damping = link.angular_damping = 0.0
    return articulation


def _chassis(sapien: Any, robot: RobotModel, axle_m: float) -> Any:  # noqa: ANN401 - sapien has no types
    """Return the body with its casters; lengths are from the axle, which is `axle_m` above the floor."""
    link = sapien.physx.PhysxArticulationLinkComponent()
    corners = hull(robot.radius_m, _GROUND_CLEARANCE_M - axle_m, robot.height_m - axle_m)
    link.attach(_stopped_by_all(sapien.physx.PhysxCollisionShapeConvexMesh(corners, [1.0, 1.0, 1.0], wall_material())))
    if robot.camera.height_m > robot.height_m:
        link.attach(_stopped_by_all(_mast(sapien, robot, axle_m)))
    caster_m = _CASTER_AT * robot.radius_m
    for ahead_m, clear_m in ((-caster_m, 0.0), (caster_m, _FRONT_CASTER_M)):
        caster = sapien.physx.PhysxCollisionShapeSphere(_CASTER_RADIUS_M, friction_against_floor(0.0))
        caster.local_pose = sapien.Pose([ahead_m, 0.0, _CASTER_RADIUS_M + clear_m - axle_m])
        caster.set_collision_groups([0, FLOOR, 0, 0])
        link.attach(caster)
    link.mass = mass_kg = (1 - 2 * _WHEEL_MASS) * robot.mass_kg
    link.cmass_local_pose = sapien.Pose([-_CENTRE_BEHIND * caster_m, 0.0, _CENTRE_HEIGHT * robot.height_m - axle_m])
    across = mass_kg * (3 * robot.radius_m**2 + robot.height_m**2) / 12
    link.inertia = [across, across, mass_kg * robot.radius_m**2 / 2]
    return link


def _mast(sapien: Any, robot: RobotModel, axle_m: float) -> Any:  # noqa: ANN401 - sapien has no types
    half_m = (robot.camera.height_m - robot.height_m) / 2
    mast = sapien.physx.PhysxCollisionShapeBox([_MAST_HALF_WIDTH_M, _MAST_HALF_WIDTH_M, half_m], wall_material())
    mast.local_pose = sapien.Pose([robot.camera.ahead_m, 0.0, robot.height_m + half_m - axle_m])
    return mast


def _stopped_by_all(shape: Any) -> Any:  # noqa: ANN401 - sapien has no types
    shape.set_collision_groups([0, FLOOR | OBSTACLE, 0, 0])
    return shape


def _wheel(sapien: Any, chassis: Any, mass_kg: float, drive: Drive, side: float) -> Any:  # noqa: ANN401
    """Return a driven wheel, to the left with `side` 1 and to the right with -1.

    It touches the floor as a ball, in one point, which rolls more smoothly than a cylinder of many faces. The hull
    holds the wheels inside, so that obstacles meet the hull only.
    """
    radius_m = drive.wheel_radius_m
    link = sapien.physx.PhysxArticulationLinkComponent(chassis)
    tyre = sapien.physx.PhysxCollisionShapeSphere(radius_m, friction_against_floor(_TYRE_FRICTION))
    tyre.set_collision_groups([0, FLOOR, 0, 0])
    link.attach(tyre)
    link.mass = wheel_kg = _WHEEL_MASS * mass_kg
    link.cmass_local_pose = sapien.Pose()
    across = wheel_kg * radius_m**2 / 4
    link.inertia = [across, 2 * across, across]
    joint = link.joint
    joint.type = "revolute"
    joint.limit = [-math.inf, math.inf]
    joint.pose_in_parent = sapien.Pose([0.0, side * drive.track_m / 2, 0.0], _AXLE)
    joint.pose_in_child = sapien.Pose([0.0, 0.0, 0.0], _AXLE)
    joint.friction = 0.0
    carried_kg = mass_kg / 2
    joint.set_drive_properties(
        stiffness=0.0,
        damping=carried_kg * radius_m**2 / _RESPONSE_S,
        force_limit=carried_kg * _TORQUE_M_S2 * radius_m,
        mode="force",
    )
    return link
