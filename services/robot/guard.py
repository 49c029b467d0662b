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
from services.robot.body import Body, View
from services.robot.clock import TICK_S
from smal.obstacles.clearance import Mount, Surroundings, most_speed

MAX_LOOK_S: Final = 0.25  # Age of a look at which nothing is free any more, seconds; as of commands.
_STEPS: Final = 20  # Shares of the speed are told in so many steps: of each that changes somebody is told.


def guard_of(body: Body[View]) -> "Guard | None":
    """Return what guards a body; None where it has no depth camera."""
    return None if body.mount is None else Guard(body.mount, body.kinematics.speed_m_s, body.braking_s)


class Guard:
    """Bounds the speed of a round robot; ``look`` is called by one thread, ``share`` by any."""

    def __init__(self, mount: Mount, speed_m_s: float, braking_s: float) -> None:
        self._mount, self._speed_m_s, self._braking_s = mount, speed_m_s, braking_s
        self._around = Surroundings(mount.radius_m)
        self._lock = threading.Lock()  # Held to look and to grant: no share is granted between two looks unnoticed.
        #: When it last saw something, and how far it was free ahead and back.
        self._seen: tuple[float, float, float] = (-math.inf, 0.0, 0.0)
        #: The largest share that was granted since the last look, and since the one before.
        self._granted = self._granted_before = 0.0

    def look(self, depth_m: NDArray[np.float32] | None, pose: Sequence[float], captured_s: float) -> None:
        """Take what the depth camera measured, and where the wheels say that the robot was."""
        if self._around.look(pose, depth_m, self._mount):
            seen = captured_s, self._around.free_m(ahead=True), self._around.free_m(ahead=False)
            with self._lock:
                self._granted_before, self._granted, self._seen = self._granted, 0.0, seen

    def share(self, velocity: Velocity, now_s: float) -> float:
        """Return the largest share of its speed, 0 to 1, at which it may go on so."""
        if velocity.linear == 0.0:
            return 1.0
        with self._lock:
            seen_s, ahead_m, back_m = self._seen
            age_s = now_s - seen_s
            if age_s > MAX_LOOK_S:
                return 0.0
            # What it may have gone since.
            gone_m = age_s * self._speed_m_s * max(self._granted, self._granted_before)
            free_m = (ahead_m if velocity.linear > 0.0 else back_m) - gone_m
            # It goes on so for a tick before it can be told otherwise.
            share = most_speed(free_m, self._speed_m_s, self._braking_s, TICK_S)
            share = math.floor(share * _STEPS) / _STEPS
            self._granted = max(self._granted, share)
            return share
