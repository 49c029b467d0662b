"""Pedestrians who walk across and along the route, stop, wait and turn back."""

import math
from functools import partial
from typing import Final

import numpy as np
from shapely import LineString

from services.simulator.world.place import Pose, World, WorldError
from services.simulator.world.route import beside, obstacles_of

#: Radius of a person, metres, and clearance to a robot ahead, in addition to both radii.
_RADIUS_M = 0.25
_ROOM_M = 0.5
#: Walking speed, in m/s and in robot speeds; the slower applies.
_SPEED_M_S = 1.2
_SPEEDS = 2.0
#: Length of a walk to either side of the route, and along it, in robot radii.
_ASIDE = (2.5, 7.5)
_ALONG = 10.0
#: Durations of walking, of standing, and of waiting for a robot before turning back, seconds.
_WALKS_S = (2.0, 8.0)
_STANDS_S = (0.0, 3.0)
_WAITS_S = 2.0
_TRIES: Final = 400


class Person:
    """A pedestrian who walks between two points, with a random start between them."""

    def __init__(self, ends: LineString, speed_m_s: float, rng: np.random.Generator) -> None:
        self._ends = ends
        self._speed_m_s = speed_m_s
        self._rng = rng
        (x, y), (to_x, to_y) = ends.coords
        self._heading = math.atan2(to_y - y, to_x - x)
        self._at_m = float(rng.uniform(0.0, ends.length))
        self._onwards = 1.0
        self._walks_s = self._stands_s = self._waited_s = 0.0

    @property
    def pose(self) -> Pose:
        """Pose of the person."""
        here = self._ends.interpolate(self._at_m)
        return Pose(here.x, here.y, self._heading + (0.0 if self._onwards > 0 else math.pi))

    def away_m(self, place: Pose) -> float:
        """Return the distance from the person's side to a pose; negative inside."""
        here = self.pose
        return math.hypot(place.x - here.x, place.y - here.y) - _RADIUS_M

    def step(self, duration_s: float, robot: Pose, radius_m: float) -> None:
        """Advance time: walk, stand, or wait for a robot ahead and turn back after a timeout."""
        here = self.pose
        x = robot.x - here.x
        y = robot.y - here.y
        ahead = x * math.cos(here.heading) + y * math.sin(here.heading) > 0.0
        self._walks_s -= duration_s
        if ahead and math.hypot(x, y) < radius_m + _RADIUS_M + _ROOM_M:
            self._waited_s += duration_s
        elif self._walks_s > 0.0:
            self._at_m += self._onwards * self._speed_m_s * duration_s
        elif self._walks_s < -self._stands_s:
            self._walks_s = self._rng.uniform(*_WALKS_S)
        self._stands_s = self._rng.uniform(*_STANDS_S)
        if self._waited_s > _WAITS_S or not 0.0 <= self._at_m <= self._ends.length:
            self._onwards = -self._onwards
            self._waited_s = 0.0
            self._at_m = min(max(self._at_m, 0.0), self._ends.length)


def walk_about(
    world: World, way: LineString, rng: np.random.Generator, count: int
) -> tuple[Person, ...]:
    """Place people about a route; raises WorldError without enough room."""
    radius_m = world.robot.radius_m
    found = list[Person]()
    speed_m_s = min(_SPEED_M_S, _SPEEDS * world.robot.drive.speed_m_s)
    for _ in range(_TRIES * count):
        along = rng.uniform(0.15, 1.0) * way.length + rng.uniform(-0.5, 0.5, 2) * _ALONG * radius_m
        aside = rng.choice([-1.0, 1.0], 2) * rng.uniform(*_ASIDE, 2) * radius_m
        ends = [(one.x, one.y) for one in map(partial(beside, way), along, aside)]
        if obstacles_of(world.place).are_clear(np.array([ends]), _RADIUS_M)[0]:
            found.append(Person(LineString(ends), speed_m_s, rng))
        if len(found) == count:
            return tuple(found)
    raise WorldError(f"{world.name}: the route has room for {len(found)} of {count} people")
