"""A base with mass: wheels, friction and contacts in PhysX, as SAPIEN has it, on the CPU; no Vulkan is needed."""

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

# A line stands for something thin: a fence, a hedge, the edge of the world.
_HALF_THICKNESS_M: Final = 0.01
# Walls end so far above a robot's top, where it never meets their upper edge.
_ABOVE_M: Final = 1.0
# PhysX warns of triangles that are much larger than what touches them.
_LONGEST_WALL_M: Final = 20.0
TIMESTEP_S: Final = 1 / 250  # Time that the engine advances by, seconds.
#: Bits of a shape's collision group: what it is (first entry), and what it is stopped by (second entry).
FLOOR: Final = 1
OBSTACLE: Final = 2
# A robot's hull glides along a wall, as plastic on plaster does.
_WALL_FRICTION: Final = 0.3
_GRAVITY: Final = (0.0, 0.0, -9.81)
load: Final = partial(load_sapien, rendering=False)

STANDING: Final = WheelSpeeds(0.0, 0.0)
#: How fast the robot's speed may grow, ahead, and shrink. Pulling ahead leans the weight on the rear caster, which
#: carries some of it even at rest, so the wheels spin earlier than in braking.
ACCELERATION_M_S2: Final = 4.0
BRAKING_M_S2: Final = 6.0
#: The same when the robot is to stand: nearly all that the tyres give, since a stop may be an emergency.
STOPPING_M_S2: Final = 9.0
TURN_ACCELERATION_RAD_S2: Final = 8.0  # How fast its turning speed may change, at the same time.
_TYRE_FRICTION: Final = 1.1  # Rubber on dry asphalt or a clean floor.
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
_CENTRE_BEHIND: Final = (
    0.1  # of the way to the rear caster: so much of the weight the caster carries
)
_CENTRE_HEIGHT: Final = 0.25  # of the body's height: batteries lie low
_GROUND_CLEARANCE_M: Final = 0.02
_MAST_HALF_WIDTH_M: Final = 0.02
_HULL_SIDES: Final = 32
# More make the drive's steady state truer: with 4 the robot is 0.2 % slow and creeps by 0.5 mm/s at rest.
_SOLVER_ITERATIONS: Final = 16
# Joints turn about their x axis; this turns it to the robot's left.
_AXLE: Final = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))
# A robot that leans more than this has toppled.
_UPRIGHT: Final = math.cos(math.radians(45))
# A robot is parked when it has moved no faster than this for a tenth of a second: the solver is noisy by millimetres a
# second, and one that rocks on its casters is faster.
_STILL_M_S: Final = 0.01
_STILL_RAD_S: Final = 0.05
_PARKED_STEPS: Final = round(0.1 / TIMESTEP_S)


def lead(now: WheelSpeeds, wanted: WheelSpeeds, track_m: float, duration_s: float) -> WheelSpeeds:
    """Return the speeds that the wheels are to have a moment later, on the way to the wanted ones.

    The robot's speed and its turning are led separately. If each wheel went its own way as fast as it can, both would
    pull with all they have while the robot speeds up, and nothing would be left to end a turn.
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
    """Put a robot into a scene, at rest, and return its articulation.

    The root is the chassis, its origin the middle of the wheels' axis, x ahead. The two joints are the left and the
    right wheel, positive forwards.
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


def _chassis(sapien: Any, robot: RobotModel, axle_m: float) -> Any:
    """Return the body with its casters; lengths are from the axle, which is `axle_m` above the floor."""
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


class PhysicalBase:
    """A base that drives by its wheels: it takes time to start and to stop, it slips, and walls push back.

    Time advances in whole steps of `TIMESTEP_S`. What is left of a duration is added to the next one, so that the pose
    is at most one such step behind the time that has been asked for. PhysX calculates with 32 bits: places are exact to
    0.01 mm at 100 m from the world's origin, and to 0.1 mm at 1 km. Without SAPIEN there is an `UnavailableError`.
    """

    def __init__(self, place: Place, drive: DriveTrain | None = None) -> None:
        self._robot = place.robot
        self._drive = drive or place.robot.drive
        #: Seconds from nominal speed to standing, along and about.
        self.braking_s = max(
            self._drive.speed_m_s / STOPPING_M_S2,
            self._drive.turn_rate_rad_s / TURN_ACCELERATION_RAD_S2,
        )
        self._scene = new_scene()
        self._obstacles = [obstacles(place.solids, place.robot.top_m)]
        self._scene.add_entity(self._obstacles[0])

    def obstruct(self, solids: Sequence[Solid]) -> None:
        """Let these stand in the way as well from the next ``put`` on, in the place of those before."""
        self._obstacles[1:] = [obstacles(solids, self._robot.top_m)] if solids else []

    def put(self, pose: Pose, rng: np.random.Generator) -> None:
        """Stand still at a pose, in a new scene: the engine remembers contacts, which would outlast an episode."""
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
        """Drive the wheels for a moment, towards the speeds that the velocity asks for."""
        wanted = self._actuator.wheels(velocity, duration_s)
        self._owed_s += duration_s
        # Durations add up to whole steps only as nearly as floating point has it.
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
            return  # a command would wake a parked robot
        self._commanded = lead(self._commanded, wanted, self._drive.track_m, TIMESTEP_S)
        for wheel, rim_speed in zip(self._wheels, self._commanded, strict=True):
            wheel.set_drive_velocity_target(rim_speed / self._drive.wheel_radius_m)

    def _park(self) -> None:
        """Let the engine rest once the robot does: small errors of its solver add up to millimetres a minute."""
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
        """Return whether an obstacle pushed the robot in the last step, or lies against it."""
        return any(
            point.separation <= 0 or point.impulse.any()
            for contact in self._scene.physx_system.get_contacts()
            if any(body in contact.bodies for body in self._bodies)
            for point in contact.points
        )

    def _rolled(self) -> tuple[float, float]:
        """Return how far the wheels have turned since the last call; the engine wraps their angles."""
        before = self._angles
        self._angles = self._articulation.qpos.tolist()
        left, right = (
            math.remainder(now - then, math.tau) * self._drive.wheel_radius_m
            for now, then in zip(self._angles, before, strict=True)
        )
        return left, right

    def _pose(self) -> tuple[Pose, bool]:
        """Return where the middle of the wheels' axis is, and whether the robot stands upright."""
        root = self._articulation.root_pose
        x, y, _ = root.p.tolist()
        w, i, j, k = root.q.tolist()
        heading = math.atan2(2 * (w * k + i * j), 1 - 2 * (j * j + k * k))
        return Pose(x, y, heading), 1 - 2 * (i * i + j * j) > _UPRIGHT


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
    shape = physx.PhysxCollisionShapeTriangleMesh(
        mesh.vertices, mesh.triangles, [1.0, 1.0, 1.0], wall_material()
    )
    shape.set_collision_groups([OBSTACLE, 0, 0, 0])
    return _static([shape])


def _rings(shape: BaseGeometry) -> list[NDArray[np.float64]]:
    """Return the closed outlines (k, 2) of all that a shape covers, each with the solid on its left."""
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
