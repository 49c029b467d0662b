"""A base with mass: wheels, friction and contacts in PhysX (SAPIEN, CPU only, no Vulkan)."""

import math
from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any, Final

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from schemas.base import Velocity
from services.simulator.base import Actuator, Motion, WheelSpeeds
from services.simulator.robots import DriveTrain, RobotModel
from services.simulator.scene.meshes import outline, quads, sides
from services.simulator.scene.vulkan import load_sapien
from services.simulator.world.place import Place, Pose, Solid

# Thickness of lines: fences, hedges, the edge of the world.
_HALF_THICKNESS_M: Final = 0.01
# Walls end this far above a robot's top, where the robot never meets their upper edge.
_ABOVE_M: Final = 1.0
# PhysX warns about triangles that are much larger than the bodies that touch them.
_LONGEST_WALL_M: Final = 20.0
TIMESTEP_S: Final = 1 / 250  # Time step of the engine, seconds.
#: Bits of a shape's collision groups: its own group, and the groups that stop it.
FLOOR: Final = 1
OBSTACLE: Final = 2
# The hull glides along walls, as plastic on plaster.
_WALL_FRICTION: Final = 0.3
_GRAVITY: Final = (0.0, 0.0, -9.81)
load: Final = partial(load_sapien, rendering=False)

STANDING: Final = WheelSpeeds(0.0, 0.0)
#: Limits of forward acceleration and deceleration. Acceleration shifts weight to the rear caster,
#: which carries some of it even at rest, so the wheels slip earlier than in braking.
ACCELERATION_M_S2: Final = 4.0
BRAKING_M_S2: Final = 6.0
#: Deceleration to standstill, nearly the limit of the tyres, since a stop can be an emergency.
STOPPING_M_S2: Final = 9.0
TURN_ACCELERATION_RAD_S2: Final = 8.0  # Limit of the turning acceleration, at the same time.
_TYRE_FRICTION: Final = 1.1  # Rubber on dry asphalt or a clean floor.
# Motor torque, as acceleration of the robot: above the tyres' limit, so that wheels slip at a wall.
_TORQUE_M_S2: Final = 12.0
# Time constant of the wheels' speed controller, within the limits of torque and friction.
_RESPONSE_S: Final = 0.01
_WHEEL_MASS: Final = 0.04  # Mass of one wheel, as a share of the robot's mass.
_CASTER_AT: Final = 0.8  # Distance ahead and behind, as a share of the robot's radius.
_CASTER_RADIUS_M: Final = 0.02
# Four touching wheels would unload the driven wheels at random. The rear caster carries weight; the
# front caster hangs this high and catches the robot in braking.
_FRONT_CASTER_M: Final = 0.005
# Distance of the centre of mass on the way to the rear caster, equal to the caster's share of the
# weight.
_CENTRE_BEHIND: Final = 0.1
_CENTRE_HEIGHT: Final = 0.25  # Share of the body's height: batteries are mounted low.
_GROUND_CLEARANCE_M: Final = 0.02
_MAST_HALF_WIDTH_M: Final = 0.02
_HULL_SIDES: Final = 32
# With 4 iterations the robot is 0.2 % slow and creeps by 0.5 mm/s at rest.
_SOLVER_ITERATIONS: Final = 16
# Joints rotate about their x axis; this rotation points it to the robot's left.
_AXLE: Final = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))
# Tilt beyond which the robot has toppled.
_UPRIGHT: Final = math.cos(math.radians(45))
# A robot is parked after a tenth of a second below these speeds: the solver's noise is some
# millimetres a second, and a robot that rocks on its casters is faster.
_STILL_M_S: Final = 0.01
_STILL_RAD_S: Final = 0.05
_PARKED_STEPS: Final = round(0.1 / TIMESTEP_S)


def lead(now: WheelSpeeds, wanted: WheelSpeeds, track_m: float, duration_s: float) -> WheelSpeeds:
    """Return the next wheel speeds on the way to the wanted speeds.

    Forward and turning speed have separate limits. If each wheel accelerated at its own limit, the
    tyres would have no grip left to end a turn.
    """
    mean = (now.left + now.right) / 2
    half = (now.right - now.left) / 2
    ahead = ACCELERATION_M_S2
    astern = BRAKING_M_S2
    if wanted == STANDING:
        ahead = astern = STOPPING_M_S2
    change = (wanted.left + wanted.right) / 2 - mean
    mean += max(-astern * duration_s, min(ahead * duration_s, change))
    most = TURN_ACCELERATION_RAD_S2 * track_m / 2 * duration_s
    half += max(-most, min(most, (wanted.right - wanted.left) / 2 - half))
    return WheelSpeeds(mean - half, mean + half)


def add_robot(scene: Any, robot: RobotModel, drive: DriveTrain, pose: Pose) -> Any:
    """Add a robot at rest to a scene and return its articulation.

    The root is the chassis; its origin is the middle of the wheels' axis, x ahead. The two joints
    are the left and the right wheel, positive forwards.
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
    # `_park` decides on sleep: the engine can take seconds, or sleep during slow driving.
    articulation.sleep_threshold = 0.0
    for link in (chassis, *wheels):
        # The default damping slows every body.
        link.linear_damping = link.angular_damping = 0.0
    return articulation


def _chassis(sapien: Any, robot: RobotModel, axle_m: float) -> Any:
    """Build the body with casters; lengths are relative to the axle, `axle_m` above the floor."""
    link = sapien.physx.PhysxArticulationLinkComponent()
    angles = np.arange(_HULL_SIDES) * math.tau / _HULL_SIDES
    ring = robot.radius_m * np.column_stack([np.cos(angles), np.sin(angles)])
    ends = [
        np.insert(ring, 2, height - axle_m, axis=1)
        for height in (_GROUND_CLEARANCE_M, robot.height_m)
    ]
    corners = np.concatenate(ends).astype(np.float32)
    shapes = [sapien.physx.PhysxCollisionShapeConvexMesh(corners, [1.0, 1.0, 1.0], wall_material())]
    half_m = (robot.camera.height_m - robot.height_m) / 2
    if half_m > 0:
        mast = sapien.physx.PhysxCollisionShapeBox(
            [_MAST_HALF_WIDTH_M, _MAST_HALF_WIDTH_M, half_m], wall_material()
        )
        mast.local_pose = sapien.Pose([robot.camera.ahead_m, 0.0, robot.height_m + half_m - axle_m])
        shapes.append(mast)
    for shape in shapes:
        shape.set_collision_groups([0, FLOOR | OBSTACLE, 0, 0])
        link.attach(shape)
    caster_m = _CASTER_AT * robot.radius_m
    for ahead_m, clear_m in ((-caster_m, 0.0), (caster_m, _FRONT_CASTER_M)):
        caster = sapien.physx.PhysxCollisionShapeSphere(
            _CASTER_RADIUS_M, friction_against_floor(0.0)
        )
        caster.local_pose = sapien.Pose([ahead_m, 0.0, _CASTER_RADIUS_M + clear_m - axle_m])
        caster.set_collision_groups([0, FLOOR, 0, 0])
        link.attach(caster)
    link.mass = mass_kg = (1 - 2 * _WHEEL_MASS) * robot.mass_kg
    link.cmass_local_pose = sapien.Pose(
        [-_CENTRE_BEHIND * caster_m, 0.0, _CENTRE_HEIGHT * robot.height_m - axle_m]
    )
    across = mass_kg * (3 * robot.radius_m**2 + robot.height_m**2) / 12
    link.inertia = [across, across, mass_kg * robot.radius_m**2 / 2]
    return link


def _wheel(sapien: Any, chassis: Any, mass_kg: float, drive: DriveTrain, side: float) -> Any:
    """Build a driven wheel, to the left with `side` 1 and to the right with -1.

    The wheel is a ball with one contact point, which rolls more smoothly than a many-sided
    cylinder. It lies inside the hull, so that obstacles touch the hull only.
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


class PhysicalBase:
    """A base with driven wheels and mass: it accelerates, brakes and slips, and walls push back.

    Time advances in whole steps of `TIMESTEP_S`. The remainder of a duration is added to the next
    duration, so the pose lags by at most one step. PhysX computes with 32 bits: positions are exact
    to 0.01 mm at 100 m from the origin, and to 0.1 mm at 1 km. Raises `UnavailableError` without
    SAPIEN.
    """

    def __init__(self, place: Place, drive: DriveTrain | None = None) -> None:
        self._robot = place.robot
        self._drive = drive or place.robot.drive
        #: Seconds from nominal speed to standstill, along and about.
        self.braking_s = max(
            self._drive.speed_m_s / STOPPING_M_S2,
            self._drive.turn_rate_rad_s / TURN_ACCELERATION_RAD_S2,
        )
        self._scene = new_scene()
        self._obstacles = [obstacles(place.solids, place.robot.top_m)]
        self._scene.add_entity(self._obstacles[0])

    def obstruct(self, solids: Sequence[Solid]) -> None:
        """Replace the additional obstacles, effective at the next ``put``."""
        self._obstacles[1:] = [obstacles(solids, self._robot.top_m)] if solids else []

    def put(self, pose: Pose, rng: np.random.Generator) -> None:
        """Place the robot at rest in a new scene, since contacts outlast an episode."""
        for entity in self._obstacles:
            if entity.scene is not None:
                self._scene.remove_entity(entity)
        self._scene = new_scene()
        for entity in self._obstacles:
            self._scene.add_entity(entity)
        self._bodies = [entity.components[0] for entity in self._obstacles]
        self._articulation = add_robot(self._scene, self._robot, self._drive, pose)
        self._wheels = self._articulation.active_joints
        self._angles = self._articulation.qpos.tolist()
        self._commanded = STANDING
        self._still_steps = 0
        self._owed_s = 0.0
        self._actuator = Actuator(self._drive, rng)

    def step(self, velocity: Velocity, duration_s: float) -> Motion:
        """Drive the wheels towards the commanded velocity."""
        wanted = self._actuator.wheels(velocity, duration_s)
        self._owed_s += duration_s
        # Durations add up to whole steps only within floating-point precision.
        steps = int(self._owed_s / TIMESTEP_S + 1e-6)
        self._owed_s -= steps * TIMESTEP_S
        collided = False
        for _ in range(steps):
            self._command(wanted)
            self._scene.physx_system.step()
            self._park()
            collided = collided or self._touches()
        pose, upright = self._pose()
        return Motion(pose, self._rolled(), collided or not upright)

    def _command(self, wanted: WheelSpeeds) -> None:
        if self._commanded == wanted == STANDING:
            return  # A command would wake a parked robot.
        self._commanded = lead(self._commanded, wanted, self._drive.track_m, TIMESTEP_S)
        for wheel, rim_speed in zip(self._wheels, self._commanded, strict=True):
            wheel.set_drive_velocity_target(rim_speed / self._drive.wheel_radius_m)

    def _park(self) -> None:
        """Put a resting robot to sleep: solver errors add up to millimetres a minute."""
        root = self._articulation.root
        still = (
            self._commanded == STANDING
            and abs(root.linear_velocity).max() < _STILL_M_S
            and abs(root.angular_velocity).max() < _STILL_RAD_S
        )
        self._still_steps = self._still_steps + 1 if still else 0
        if self._still_steps >= _PARKED_STEPS and not root.sleeping:
            root.put_to_sleep()

    def _touches(self) -> bool:
        """Return whether an obstacle touched the robot in the last step."""
        return any(
            point.separation <= 0 or point.impulse.any()
            for contact in self._scene.physx_system.get_contacts()
            if any(body in contact.bodies for body in self._bodies)
            for point in contact.points
        )

    def _rolled(self) -> tuple[float, float]:
        """Return the distances rolled since the last call; the engine wraps the angles."""
        before = self._angles
        self._angles = self._articulation.qpos.tolist()
        left, right = (
            math.remainder(now - then, math.tau) * self._drive.wheel_radius_m
            for now, then in zip(self._angles, before, strict=True)
        )
        return left, right

    def _pose(self) -> tuple[Pose, bool]:
        """Return the pose of the axis's middle, and whether the robot is upright."""
        root = self._articulation.root_pose
        x, y, _ = root.p.tolist()
        w, i, j, k = root.q.tolist()
        heading = math.atan2(2 * (w * k + i * j), 1 - 2 * (j * j + k * k))
        return Pose(x, y, heading), 1 - 2 * (i * i + j * j) > _UPRIGHT


def new_scene() -> Any:
    """Create a scene with gravity and a level floor at height 0.

    PhysX averages the friction of two surfaces. The floor's friction is 0, so that the wheel or
    caster decides; see `friction_against_floor`.
    """
    sapien = load()
    physx = sapien.physx
    # These settings belong to the process: the next system takes them, earlier systems keep theirs.
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
    """Create a material with a friction coefficient (at least 0) against the floor."""
    return load().physx.PhysxMaterial(2 * coefficient, 2 * coefficient, 0.0)


def wall_material() -> Any:
    """Create the material of obstacles and of bodies that hit them, without restitution."""
    return load().physx.PhysxMaterial(_WALL_FRICTION, _WALL_FRICTION, 0.0)


def obstacles(solids: Iterable[Solid], under_m: float) -> Any:
    """Build the walls of solids as a static entity that can move from scene to scene.

    Solids that begin at `under_m` (the robot's height) or above are omitted: the robot drives under
    them. Walls end a metre above the robot. Lines are 2 cm thick.
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
    shape = physx.PhysxCollisionShapeTriangleMesh(
        mesh.vertices, mesh.triangles, [1.0, 1.0, 1.0], wall_material()
    )
    shape.set_collision_groups([OBSTACLE, 0, 0, 0])
    return _static([shape])


def _rings(shape: BaseGeometry) -> list[NDArray[np.float64]]:
    """Return the closed outlines (k, 2) of a shape, each with the solid on its left."""
    parts = [
        part
        if part.geom_type == "Polygon"
        else part.buffer(_HALF_THICKNESS_M, cap_style="square", join_style="mitre")
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
