"""The scripted expert: the key to hold, by the true pose and the route."""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from schemas.base import KEYS, Atom, Velocity
from schemas.command import Command
from schemas.motion import TruePose
from schemas.rpc import ResetReply
from services.kit.errors import JobError

# Duration of a recovery drive in frames (8 s at 10 Hz).
RECOVERY_TICKS: Final = 80
# Timeout of a full drive in frames: four times as many as 1 km takes at 2 m/s.
DRIVE_TICKS: Final = 20_000
LOOKAHEAD_S: Final = 1.25
#: Heading errors at which a person starts and stops a correction, radians.
START_TURNING_RAD: Final = math.radians(7.0)
STOP_TURNING_RAD: Final = math.radians(3.0)
#: Share of the found distance from the victim at which the driver has arrived.
ARRIVED_FRACTION: Final = 0.5


class RouteDriver:
    """Follows a route (at least two way points, metres) with the keys forward, left and right.

    `speed_m_s` is the robot's nominal speed; `found_m` is the distance from the route's end, the
    victim, that counts as found. A `car` keeps driving ahead while it turns.
    """

    def __init__(
        self,
        route: Sequence[tuple[float, float]],
        speed_m_s: float,
        found_m: float,
        *,
        car: bool = False,
    ) -> None:
        if len(route) < 2:
            raise ValueError("a route needs at least two way points")
        self._points = np.asarray(route, dtype=np.float64)
        self._lengths = np.hypot(*np.diff(self._points, axis=0).T)
        self._along = np.concatenate([[0.0], np.cumsum(self._lengths)])
        self._lookahead_m = LOOKAHEAD_S * speed_m_s
        self._arrived_m = ARRIVED_FRACTION * found_m
        self._progress_m = 0.0
        self._turning: Atom | None = None
        self._car = car

    def arrived(self, x: float, y: float) -> bool:
        """Return whether the robot is close enough to the route's end."""
        return math.dist((x, y), self._points[-1]) <= self._arrived_m

    def velocity(self, x: float, y: float, heading: float) -> Velocity:
        """Return the velocity of the key at a pose."""
        key = KEYS[self.key(x, y, heading)]
        return key._replace(linear=1.0) if self._car else key

    def key(self, x: float, y: float, heading: float) -> Atom:
        """Return the key to hold at a pose (metres, radians counter-clockwise from east)."""
        self._progress_m = self._project(np.array([x, y]))
        target = self._point_at(self._progress_m + self._lookahead_m)
        bearing = math.atan2(target[1] - y, target[0] - x)
        error = math.remainder(bearing - heading, math.tau)
        if self._turning is None and abs(error) > START_TURNING_RAD:
            self._turning = "left" if error > 0 else "right"
        elif self._turning is not None and (
            abs(error) < STOP_TURNING_RAD or (error > 0) != (self._turning == "left")
        ):
            self._turning = None
        return self._turning or "forward"

    def _project(self, position: NDArray[np.float64]) -> float:
        """Return the distance along the route of the nearest point within reach."""
        near = self._progress_m
        far = self._progress_m + 2 * self._lookahead_m
        candidates = np.linspace(near, min(far, float(self._along[-1])), 64)
        points = self._point_at(candidates)
        return float(candidates[np.argmin(((points - position) ** 2).sum(axis=1))])

    def _point_at(self, along_m: float | NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the points at distances along the route, shape (..., 2)."""
        return np.stack(
            [np.interp(along_m, self._along, self._points[:, axis]) for axis in (0, 1)], axis=-1
        )


class ExpertService:
    """Commands once for every frame.

    After its arrival the expert sends no command: the client ends the episode, and the number of
    frames must not depend on which of the two comes first.
    """

    def __init__(self) -> None:
        self._episode = ""
        self._driver: RouteDriver | None = None
        self._last: Command | None = None
        self.arrived = False

    def begin(self, reset: ResetReply) -> None:
        """Start on the route of an episode; raises JobError if the world has no known route."""
        if reset.found_m is None or len(reset.route) < 2:
            raise JobError(
                f"{reset.world}: no known route to the goal; demonstrate it with smal teleop"
            )
        self._episode = reset.episode
        self._driver = RouteDriver(reset.route, reset.speed_m_s, reset.found_m, car=reset.car)
        self._last = None
        self.arrived = False

    def handle(self, pose: TruePose) -> Command | None:
        """Return the command for the frame of this true pose; a frame sent again gets it again."""
        if self._driver is None or self.arrived or pose.episode != self._episode:
            return None
        if self._last is None or self._last.tick != pose.tick:
            self.arrived = self._driver.arrived(pose.x_m, pose.y_m)
            if self.arrived:
                return None
            velocity = self._driver.velocity(*pose.pose)
            self._last = Command.after(pose, source="expert", **velocity._asdict())
        return self._last
