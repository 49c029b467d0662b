"""Simulated robot as a `Body`; in real-time mode its world advances by the clock."""

import math
from collections.abc import Callable
from threading import Lock
from typing import Final

import shapely

from schemas.base import STANDING, TICK_S, Velocity
from schemas.rpc import ResetRequest
from schemas.topics import DEPTH, OVERHEAD, Topic
from services.kit.node import Detail, ServiceError
from services.robot.body import CONDITIONS, Beginning, Kinematics
from services.robot.clock import now_s
from services.simulator.base import STEP_S
from services.simulator.sensors.camera import FIELD_OF_VIEW_DEG, SimulatedView
from services.simulator.simulation import Simulation
from services.simulator.variation import VARIATIONS
from services.simulator.world.place import Pose, WorldError
from services.simulator.worlds import Worlds
from smal.camera import Camera

# Watchdog timeout of the simulated base, seconds; real bases have a similar one.
WATCHDOG_S: Final = 0.2

STOOD_S: Final = 2.0  # Maximum time until a stopped base is at rest, with a generous margin.


class SimulatedBody:
    """A `Simulation` behind the interface `services.robot.body.Body`.

    Like a real base, it executes the last command until the next one or until the watchdog expires.
    Elapsed time is simulated at the next command or view, so that a delayed thread or process finds
    the robot at the correct pose.

    Parameters
    ----------
    simulation : Simulation
        World that the robot starts in.
    clock : callable
        Monotonic time in seconds.
    wanted : callable
        Returns whether a topic has subscribers.
    worlds : Worlds, optional
        Opens other worlds; if omitted, the robot stays in its world.
    """

    watchdog_s = WATCHDOG_S
    frame_s = TICK_S
    conditions = CONDITIONS

    def __init__(
        self,
        simulation: Simulation,
        clock: Callable[[], float] = now_s,
        wanted: Callable[[Topic], bool] = lambda _topic: False,
        worlds: Worlds | None = None,
    ) -> None:
        for topic in (DEPTH, OVERHEAD):
            # Zenoh discovers subscribers with a delay: without this query the first frame has no
            # depth image.
            wanted(topic)
        self._clock = clock
        self._wanted = wanted
        self._worlds = worlds
        self._lock = Lock()
        self._kidnap_tick: int | None = None
        self._realtime = False
        self._order = STANDING
        self._ordered_s = self._moved_s = clock()
        self._enter(simulation)

    def _enter(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self.name = simulation.name
        drive = simulation.world.robot.drive
        self.camera = Camera.of_field(FIELD_OF_VIEW_DEG)
        self.kinematics = Kinematics(drive.speed_m_s, drive.turn_rate_rad_s, drive.radius_m)
        self.braking_s = simulation.braking_s
        self.mount = simulation.mount

    def begin(self, request: ResetRequest) -> Beginning:
        """Begin an episode at a seeded start.

        Raises
        ------
        ServiceError
            The world is unusable; the robot stays where it is.
        """
        self._go_where_asked(request)
        with self._lock:
            try:
                self.simulation.reset(
                    request.seed, request.purpose, start=request.start, victim=request.victim,
                    obstacles=request.obstacles, people=request.people, blocked=request.blocked,
                )  # fmt: skip
                route = tuple((float(x), float(y)) for x, y in self.simulation.route())
            except WorldError as error:
                raise ServiceError(str(error)) from None
            self._kidnap_tick = request.kidnap_tick
            self._realtime = request.mode == "realtime"
            self._order = STANDING
            self._ordered_s = self._moved_s = self._clock()
        lies = self.simulation.victim
        outlines = (
            shapely.get_coordinates(one.footprint).tolist() for one in self.simulation.obstacles
        )
        things = tuple(tuple((x, y) for x, y in outline) for outline in outlines)
        return Beginning(
            route, self.simulation.found_m, None if lies is None else (lies.x, lies.y), things
        )

    def _go_where_asked(self, request: ResetRequest) -> None:
        wished = request.world, request.variation
        if self._worlds is None:
            if wished != (None, None):
                raise ServiceError(f"the robot stays in {self.name}")
        elif any(
            wish not in (None, here) for wish, here in zip(wished, self._worlds.here, strict=True)
        ):
            if request.start == "here":
                raise ServiceError(f"the robot stands in {self.name}; begin here in that world")
            self._enter(self._worlds.open(*wished))

    def drive(self, velocity: Velocity) -> Velocity:
        """Set the velocity to hold; in lockstep only ``advance`` moves the world."""
        if not self._realtime:
            return velocity
        with self._lock:
            now = self._clock()
            self._catch_up(now)
            self._order = velocity
            self._ordered_s = now
        return velocity

    def stand(self) -> None:
        """Stop the robot."""
        self.drive(STANDING)

    def _catch_up(self, now_s: float) -> None:
        """Simulate the elapsed time with the last command and the watchdog."""
        stops_s = min(now_s, self._ordered_s + WATCHDOG_S)
        self._move_on(self._order, stops_s)
        self._move_on(STANDING, min(now_s, stops_s + STOOD_S))
        if now_s - self._moved_s > STEP_S:
            self._moved_s = now_s  # At rest: hours of suspension need no steps.

    def _move_on(self, order: Velocity, until_s: float) -> None:
        while self._moved_s + STEP_S <= until_s:
            self._moved_s += STEP_S
            self.simulation.advance(order, STEP_S)

    def advance(self, velocity: Velocity, duration_s: float) -> None:
        """Move the robot in lockstep."""
        self.simulation.advance(velocity, duration_s)

    @property
    def pose(self) -> tuple[float, float, float]:
        """Ground truth: metres, and radians from east."""
        pose = self.simulation.pose
        return pose.x, pose.y, math.remainder(pose.heading, math.tau)

    def carry(self, x_m: float, y_m: float, heading_rad: float) -> None:
        """Move the robot elsewhere at rest; ServiceError if the place is not free."""
        with self._lock:
            if self._realtime:
                self._catch_up(self._clock())
            try:
                self.simulation.carry(Pose(x_m, y_m, heading_rad))
            except WorldError as error:
                raise ServiceError(str(error)) from None

    def choose_task(self, start: tuple[float, float], goal: tuple[float, float]) -> None:
        """Move start and goal of the world, metres; ServiceError without a free way."""
        with self._lock:
            try:
                self.simulation.choose_task(start, goal)
            except WorldError as error:
                raise ServiceError(str(error)) from None
            world = self.simulation.world
            if self._worlds is not None:
                self._worlds.tasks[self._worlds.here[0]] = world.start, world.victim
            self._order = STANDING
            self._ordered_s = self._moved_s = self._clock()

    def look(self, tick: int) -> SimulatedView:
        """Return the view of a tick; at the kidnap tick the robot is moved first."""
        with self._lock:
            now = self._clock()
            if self._realtime:
                self._catch_up(now)
            if tick and tick == self._kidnap_tick:
                self.simulation.carry_away()
            return self.simulation.look(now, self._wanted)

    def peek(self) -> bytes:
        """Render the camera image between two episodes, as JPEG."""
        return self.look(0).jpeg

    def detail(self) -> Detail:
        """Report the variation of the world and the worlds that can be opened."""
        if self._worlds is None:
            return {}
        _, variation = self._worlds.here
        world = self.simulation.world
        start = world.start
        victim = world.victim
        return {
            "task": f"({start.x:.1f}, {start.y:.1f}) to ({victim.x:.1f}, {victim.y:.1f})",
            "variation": variation,
            "variations": ", ".join(VARIATIONS),
            "worlds": ", ".join(self._worlds.names()),
        }
