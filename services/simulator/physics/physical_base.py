"""A base with mass: the wheels are driven in PhysX, and what the robot does follows from friction and contacts."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

from services.simulator.base import Motion
from services.simulator.drive import Actuator, WheelSpeeds
from services.simulator.physics.articulation import add_robot
from services.simulator.physics.collision_shapes import upright_sides
from services.simulator.physics.engine import TIMESTEP_S, new_scene, obstacle_entity
from services.simulator.physics.motors import STANDING, STOPPING_M_S2, TURN_ACCELERATION_RAD_S2, lead
from services.simulator.world.place import Pose

if TYPE_CHECKING:
    import numpy as np

    from schemas.base import Atom
    from services.simulator.robots import Drive
    from services.simulator.world.place import Place

# A robot that leans more than this has toppled.
_UPRIGHT: Final = math.cos(math.radians(45))
# A robot is parked when it has moved no faster than this for a tenth of a second: the solver is noisy by millimetres a
# second, and one that rocks on its casters is faster.
_STILL_M_S: Final = 0.01
_STILL_RAD_S: Final = 0.05
_PARKED_STEPS: Final = round(0.1 / TIMESTEP_S)


class PhysicalBase:
    """A base that drives by its wheels: it takes time to start and to stop, it slips, and walls push back.

    Time advances in whole steps of `TIMESTEP_S`. What is left of a duration is added to the next one, so that the
    pose is at most one such step behind the time that has been asked for. PhysX calculates with 32 bits: places are
    exact to 0.01 mm at 100 m from the world's origin, and to 0.1 mm at 1 km.

    Parameters
    ----------
    place
        Where it drives, and with which robot.
    drive
        Other wheels than the robot's.

    Raises
    ------
    PhysicsUnavailableError
        SAPIEN, with PhysX in it, is not installed.
    """

    def __init__(self, place: Place, drive: Drive | None = None) -> None:
        self._robot = place.robot
        self._drive = drive or place.robot.drive
        self._scene = new_scene()
        self._obstacles = obstacle_entity(upright_sides(place.solids, place.robot.top_m))
        self._scene.add_entity(self._obstacles)

    @property
    def braking_s(self) -> float:
        """Seconds from nominal speed to standing, along and about."""
        return max(self._drive.speed_m_s / STOPPING_M_S2, self._drive.turn_rate_rad_s / TURN_ACCELERATION_RAD_S2)

    def put(self, pose: Pose, rng: np.random.Generator) -> None:
        """Stand still at a pose, in a new scene: the engine remembers contacts, which would outlast an episode."""
        self._scene.remove_entity(self._obstacles)
        self._scene = new_scene()
        self._scene.add_entity(self._obstacles)
        self._body = self._obstacles.components[0]
        self._articulation = add_robot(self._scene, self._robot, self._drive, pose)
        self._wheels = self._articulation.active_joints
        self._angles = self._articulation.qpos.tolist()
        self._commanded = STANDING
        self._still_steps = 0
        self._owed_s = 0.0
        self._actuator = Actuator(self._drive, rng)

    def step(self, atom: Atom, speed: float, duration_s: float) -> Motion:
        """Drive the wheels for a moment, towards the speeds that the atom movement asks for."""
        wanted = self._actuator.wheels(atom, speed, duration_s)
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
            if self._body in contact.bodies
            for point in contact.points
        )

    def _rolled(self) -> tuple[float, float]:
        """Return how far the wheels have turned since the last call; the engine wraps their angles."""
        before, self._angles = self._angles, self._articulation.qpos.tolist()
        left, right = (
            math.remainder(now - then, math.tau) * self._drive.wheel_radius_m
            for now, then in zip(self._angles, before, strict=True)
        )
        return left, right

    def _pose(self) -> tuple[Pose, bool]:
        """Return where the middle of the wheels' axis is, and whether the robot stands upright."""
        root: Any = self._articulation.root_pose
        x, y, _ = root.p.tolist()
        w, i, j, k = root.q.tolist()
        heading = math.atan2(2 * (w * k + i * j), 1 - 2 * (j * j + k * k))
        return Pose(x, y, heading), 1 - 2 * (i * i + j * j) > _UPRIGHT
