"""A world with the robot in it: reset, advance, look; independent of messages and ticks."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray
from shapely import LineString, Point

from schemas.base import Velocity
from schemas.episode import Purpose, Victim
from schemas.rpc import Start
from schemas.topics import Topic
from services.simulator.base import STEP_S, Base, KinematicBase
from services.simulator.sensors.camera import FOCAL, CameraSettings, SimulatedView
from services.simulator.sensors.readings import Sensors
from services.simulator.variation import DAY, Variation
from services.simulator.world.obstacles import Obstacle, stand_in_the_way
from services.simulator.world.people import Person, walk_about
from services.simulator.world.place import Pose, World, WorldError
from services.simulator.world.route import (
    first_pose,
    obstacles_of,
    plan_route,
)
from services.simulator.world.task import moved_victim, sample_start
from smal.obstacles.clearance import Mount

if TYPE_CHECKING:
    from services.simulator.scene.rendering import SceneCamera

_PURPOSE_NUMBER: Final[dict[Purpose, int]] = {"drive": 0, "run": 1, "recovery": 2}


class Simulation:
    """A robot with a camera in a world.

    Parameters
    ----------
    world : World
        Place and task.
    camera : SceneCamera or CameraSettings
        Camera, or settings of a rendered camera.
    base : Base, optional
        By default a `KinematicBase`.
    shake : float, optional
        Factor of the camera shake; by default the place's own.
    variation : Variation
        Only haze and exposure apply here; the rest is already in the world and its light.
    depth : bool
        Whether the robot has a depth camera and avoids visible obstacles.
    """

    pose: Pose  # Ground truth.
    collided: bool  # Whether the robot has touched an obstacle since the reset.
    victim: Pose | None  # Ground truth.
    obstacles: tuple[Obstacle, ...] = ()  # Obstacles on the route that were absent in teaching.
    people: tuple[Person, ...] = ()  # Pedestrians.

    def __init__(
        self,
        world: World,
        camera: "SceneCamera | CameraSettings",
        base: "Base | None" = None,
        *,
        shake: float | None = None,
        variation: Variation = DAY,
        depth: bool = False,
    ) -> None:
        if isinstance(camera, CameraSettings):
            from services.simulator.scene.rendering import SceneCamera  # noqa: PLC0415 - only this needs a renderer

            camera = SceneCamera(world, camera)
        self.world = world
        self.name = world.name
        self.speed_m_s = world.robot.drive.speed_m_s
        self.found_m = world.scale.found_m
        self._seen = world, camera, variation
        #: Mounting of the depth camera, identical to the colour camera's.
        mast = world.robot.camera
        radius_m = world.robot.radius_m
        self.mount = (
            Mount(FOCAL, mast.height_m, mast.ahead_m, radius_m, world.robot.top_m)
            if depth
            else None
        )
        self._base = base or KinematicBase(world.place, world.robot.drive)
        self.braking_s = self._base.braking_s
        self._sensors = Sensors(world.robot.drive, world.place.shake if shake is None else shake)
        self.reset(0, "drive")

    def reset(
        self,
        seed: int,
        purpose: Purpose,
        *,
        start: Start = "start",
        victim: Victim = "there",
        obstacles: int = 0,
        people: int = 0,
        blocked: bool = False,
    ) -> Pose:
        """Begin an episode; the same seed and purpose reproduce it.

        Parameters
        ----------
        seed : int
            Seed of start, wheel errors, sensor noise, shake and obstacles. Purposes with the same
            seed are independent.
        purpose : Purpose
            Purpose of the episode; sets the scatter of the start.
        start : Start
            Kind of the start; "here" keeps the present pose.
        victim : Victim
            Placement of the victim.
        obstacles, people : int
            Number of obstacles and of pedestrians.
        blocked : bool
            Whether an obstacle closes the route.

        Returns
        -------
        Pose
            Start pose.

        Raises
        ------
        WorldError
            The world has too little room for these obstacles or people, or for a start here.
        """
        self._seed = seed, _PURPOSE_NUMBER[purpose]
        place, wheels, odometry, imu, shake = (self._chance(stream) for stream in range(5))
        self.pose = self._start = self._start_pose(start, purpose, place)
        self._obstruct(obstacles, blocked)
        self.people = (
            walk_about(self.world, LineString(self.route()), self._chance(9), people)
            if people
            else ()
        )
        self._base.put(self._start, wheels)
        self._sensors.begin(self._start, odometry, imu, shake)
        self.collided = False
        self._lay(victim)
        return self.pose

    def _start_pose(self, start: Start, purpose: Purpose, chance: np.random.Generator) -> Pose:
        if start == "here":
            self._check_room(self.pose)
            return self.pose
        pose = sample_start(self.world, chance, "recovery" if start == "anywhere" else purpose)
        return pose.turned_round if start == "turned" else pose

    def _check_room(self, pose: Pose) -> None:
        """Raise WorldError if the robot has no room to turn at a pose."""
        x_min, y_min, x_max, y_max = self.world.place.bounds
        at = f"({pose.x:.1f}, {pose.y:.1f}) m"
        if not (x_min < pose.x < x_max and y_min < pose.y < y_max):
            raise WorldError(f"{at} is outside of {self.name}; choose a place on its map")
        room_m = self.world.scale.start_room_m
        if self._away_m(pose) < room_m:
            raise WorldError(
                f"no room for the robot at {at}: it needs {room_m:g} m to the nearest obstacle; "
                "choose a free place"
            )

    def _lay(self, victim: Victim) -> None:
        chance = self._chance(7)
        taught = self.world.victim
        self.victim = (
            taught
            if victim == "there"
            else moved_victim(self.world, chance)
            if victim == "moved"
            else None
        )
        self._seen[1].lay(
            self.victim, taught if victim == "decoy" else None, int(chance.integers(1 << 16))
        )

    def _obstruct(self, count: int, blocked: bool) -> None:
        things: tuple[Obstacle, ...] = ()
        if count or blocked:
            things = stand_in_the_way(
                self.world, self._start, self._chance(8), count, blocked=blocked
            )
        if things == self.obstacles:
            return
        self.obstacles = things
        self._base.obstruct([solid for thing in things for solid in thing.solids])
        self._seen[1].obstruct(things)

    def carry_away(self) -> Pose:
        """Move the robot to a seeded pose beside the route, without turning its wheels."""
        chance = self._chance(5)
        room_m = self.world.scale.start_room_m
        self.pose = sample_start(self.world, chance, "recovery")
        while any(
            thing.footprint.distance(Point(self.pose.x, self.pose.y)) < room_m
            for thing in self.obstacles
        ):
            self.pose = sample_start(self.world, chance, "recovery")
        self._base.put(self.pose, self._chance(6))
        return self.pose

    def carry(self, pose: Pose) -> None:
        """Move the robot to a pose without turning its wheels; WorldError if it is not free."""
        self._check_room(pose)
        self.pose = pose
        self._base.put(pose, self._chance(6))

    def choose_task(self, start: tuple[float, float], goal: tuple[float, float]) -> None:
        """Move start and victim of the world, and the robot to the start.

        Raises
        ------
        WorldError
            A place is not free, or no free way connects them; the world stays as it is.
        """
        before = self.world
        for x, y in (start, goal):
            self._check_room(Pose(x, y, 0.0))
        victim = replace(before.victim, x=goal[0], y=goal[1])
        route = plan_route(replace(before, victim=victim), start)
        apart_m = math.dist(start, goal)
        if apart_m < self.found_m:
            raise WorldError(
                f"start and goal are too close ({apart_m:.1f} m < minimum {self.found_m:g} m); "
                "choose them further apart"
            )
        try:
            self._enter(replace(before, start=first_pose(route), victim=victim))
        except WorldError:
            self._enter(before)
            raise

    def _enter(self, world: World) -> None:
        self.world = world
        self._seen = world, *self._seen[1:]
        self.reset(0, "drive")

    def _chance(self, stream: int) -> np.random.Generator:
        """Return a random generator of the episode; stream numbers are part of the seed."""
        return np.random.default_rng([*self._seed, stream])

    def advance(self, velocity: Velocity, duration_s: float) -> None:
        """Move the robot; obstacles stop it on contact."""
        steps = max(1, math.ceil(duration_s / STEP_S - 1e-9))
        for _ in range(steps):
            motion = self._base.step(velocity, duration_s / steps)
            self.pose = motion.pose
            for person in self.people:
                person.step(duration_s / steps, self.pose, self.world.robot.radius_m)
            self.collided |= motion.collided or any(
                person.away_m(self.pose) < self.world.robot.radius_m for person in self.people
            )
            if duration_s > 0:
                self._sensors.feel(motion, duration_s / steps)

    def look(
        self, captured_s: float = 0.0, wanted: Callable[[Topic], bool] = lambda _topic: False
    ) -> SimulatedView:
        """Return the current view with the sensor readings since the last call.

        `captured_s` and `wanted` are fields of `SimulatedView`.
        """
        felt = self._sensors
        return SimulatedView(
            *self._seen, self.pose, felt.shake.tilt, felt.shake.rate, self.collided, felt.odometer.read(), felt.imu(),
            self.victim, tuple(one.pose for one in self.people), self.mount, captured_s, wanted,
        )  # fmt: skip

    @property
    def clearance_m(self) -> float:
        """Distance from the robot's side to the nearest obstacle, metres; 0 on contact."""
        return max(self._away_m(self.pose) - self.world.robot.radius_m, 0.0)

    def _away_m(self, pose: Pose) -> float:
        """Return the distance from a robot's centre to the nearest obstacle, metres."""
        here = Point(pose.x, pose.y)
        away_m = [obstacles_of(self.world.place).clearance(here.x, here.y)]
        away_m += [thing.footprint.distance(here) for thing in self.obstacles]
        away_m += [person.away_m(pose) for person in self.people]
        return min(away_m)

    def route(self) -> NDArray[np.float64]:
        """Return the route (k, 2), in metres, from the start of this episode to the victim."""
        return plan_route(self.world, (self._start.x, self._start.y))
