"""What keeps a robot from running into things, whoever drives it: how fast its depth camera lets it go.

It goes as fast as it can still stand before the first thing on its way, or before what is not known to be free. A depth
camera that is silent, shows nothing, or was too old, makes nothing free. Turning on the spot touches nothing new.
"""

import math
import threading
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from schemas.base import Velocity
from services.robot.body import Body, Kinematics, View
from services.robot.clock import TICK_S
from smal.obstacles.clearance import Mount, Surroundings, most_speed

MAX_LOOK_S: Final = 0.25  # Age of a look at which nothing is free any more, seconds; as of commands.
_STEPS: Final = 20  # Shares of the speed are told in so many steps: of each that changes somebody is told.


def guard_of(body: Body[View]) -> "Guard | None":
    """Return what guards a body; None where it has no depth camera."""
    return None if body.mount is None else Guard(body.mount, body.kinematics, body.braking_s)


class Guard:
    """Bounds the speed of a round robot; ``look`` is called by one thread, ``share`` by any."""

    def __init__(self, mount: Mount, kinematics: Kinematics, braking_s: float) -> None:
        self._mount, self._kinematics, self._braking_s = mount, kinematics, braking_s
        self._around = Surroundings(mount.radius_m)
        self._lock = threading.Lock()  # Held to look and to grant: no share is granted between two looks unnoticed.
        self._seen_s = -math.inf  # When it last saw something,
        self._free_m = dict[Velocity, float]()  # and how far it was free then along what was asked for since.
        #: The largest share that was granted since the last look, and since the one before.
        self._granted = self._granted_before = 0.0

    def look(self, depth_m: NDArray[np.float32] | None, pose: Sequence[float], captured_s: float) -> None:
        """Take what the depth camera measured, and where the wheels say that the robot was."""
        with self._lock:
            if self._around.look(pose, depth_m, self._mount):
                self._granted_before, self._granted, self._seen_s = self._granted, 0.0, captured_s
                self._free_m.clear()

    def share(self, velocity: Velocity, now_s: float) -> float:
        """Return the largest share of its speed, 0 to 1, at which it may go on along the arc of a velocity."""
        linear, angular = velocity
        if linear == 0.0:
            return 1.0
        speed_m_s = self._kinematics.speed_m_s
        with self._lock:
            age_s = now_s - self._seen_s
            if age_s > MAX_LOOK_S:
                return 0.0
            if velocity not in self._free_m:
                bend = angular * self._kinematics.turn_rate_rad_s / (linear * speed_m_s)
                self._free_m[velocity] = self._around.free_m(linear > 0.0, bend)
            # What it may have gone since.
            free_m = self._free_m[velocity] - age_s * speed_m_s * max(self._granted, self._granted_before)
            # It goes on so for a tick before it can be told otherwise.
            share = math.floor(most_speed(free_m, speed_m_s, self._braking_s, TICK_S) * _STEPS) / _STEPS
            self._granted = max(self._granted, share)
            return share
