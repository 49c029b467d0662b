"""The simulated robot as a body: in real time its world moves on by the clock, whoever is slow."""

from collections.abc import Callable
from threading import Lock
from typing import Final

import shapely

from schemas.base import STANDING, Velocity
from schemas.rpc import ResetRequest
from schemas.topics import DEPTH, OVERHEAD, Topic
from services.kit.node import Detail, ServiceError
from services.robot.body import Beginning, Kinematics
from services.robot.clock import now_s
from services.simulator.base import STEP_S
from services.simulator.sensors.camera import FIELD_OF_VIEW_DEG, SimulatedView
from services.simulator.simulation import Simulation
from services.simulator.variation import VARIATIONS
from services.simulator.world.place import WorldError
from services.simulator.worlds import Worlds
from smal.camera import Camera

WATCHDOG_S: Final = (
    0.2  # Silence after which the simulated base stands by itself, as those of real robots do.
)

STOOD_S: Final = 2.0  # Time within which a base that was told to stand does so and is at rest, with much to spare.


class SimulatedBody:
    """A `Simulation` as `services.robot.body.Body` asks for it.

    Like a real base it goes on with its last order until it has another one, or its watchdog bites; what passed
    meanwhile is made up for at the next order or look, so that a thread or a process that had no processor finds the
    robot where it would be. `wanted` says whether anybody listens to a topic, `worlds` opens other worlds; without it
    the robot stays in the one that it is in.
    """

    watchdog_s = WATCHDOG_S

    def __init__(
        self,
        simulation: Simulation,
        clock: Callable[[], float] = now_s,
        wanted: Callable[[Topic], bool] = lambda _topic: False,
        worlds: Worlds | None = None,
    ) -> None:
        for topic in (DEPTH, OVERHEAD):
            # Who listens becomes known a moment after it was asked for the first time: the first frame is too late.
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
        """Put the robot at a seeded start; ServiceError where the world cannot be used, and the robot stays."""
        self._go_where_asked(request)
        with self._lock:
            try:
                self.simulation.reset(
                    request.seed, request.purpose, anywhere=request.start == "anywhere", victim=request.victim,
                    obstacles=request.obstacles, people=request.people, blocked=request.blocked,
                )  # fmt: skip
            except WorldError as error:
                raise ServiceError(str(error)) from None
            self._kidnap_tick = request.kidnap_tick
            self._realtime = request.mode == "realtime"
            self._order = STANDING
            self._ordered_s = self._moved_s = self._clock()
        route = tuple((float(x), float(y)) for x, y in self.simulation.route())
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
            self._enter(self._worlds.open(*wished))

    def drive(self, velocity: Velocity) -> Velocity:
        """Go on with a velocity until told otherwise; in lockstep the world only moves when ``advance`` has it so."""
        if not self._realtime:
            return velocity
        with self._lock:
            now = self._clock()
            self._catch_up(now)
            self._order = velocity
            self._ordered_s = now
        return velocity

    def stand(self) -> None:
        """Stop, and stay."""
        self.drive(STANDING)

    def _catch_up(self, now_s: float) -> None:
        """Move as the last order and the watchdog have it."""
        stops_s = min(now_s, self._ordered_s + WATCHDOG_S)
        self._move_on(self._order, stops_s)
        self._move_on(STANDING, min(now_s, stops_s + STOOD_S))
        if now_s - self._moved_s > STEP_S:
            self._moved_s = now_s  # it stands since: hours of suspension need no steps

    def _move_on(self, order: Velocity, until_s: float) -> None:
        while self._moved_s + STEP_S <= until_s:
            self._moved_s += STEP_S
            self.simulation.advance(order, STEP_S)

    def advance(self, velocity: Velocity, duration_s: float) -> None:
        """Move the robot in lockstep."""
        self.simulation.advance(velocity, duration_s)

    def look(self, tick: int) -> SimulatedView:
        """Return what is seen and felt now; at its tick the robot is carried away before."""
        with self._lock:
            now = self._clock()
            if self._realtime:
                self._catch_up(now)
            if tick and tick == self._kidnap_tick:
                self.simulation.carry_away()
            return self.simulation.look(now, self._wanted)

    def peek(self) -> bytes:
        """Return what its camera sees between two episodes, as JPEG."""
        return self.look(0).jpeg

    def detail(self) -> Detail:
        """Tell in which variation of its world it is, and where else it can be."""
        if self._worlds is None:
            return {}
        _, variation = self._worlds.here
        return {
            "variation": variation,
            "variations": ", ".join(VARIATIONS),
            "worlds": ", ".join(self._worlds.names()),
        }
