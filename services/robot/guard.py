"""Bound the robot's speed by its depth camera, for every driver.

The robot drives only as fast as it can stop before the first obstacle on its way, or before ground
that is not known to be free. If the depth camera is silent, shows no ground or is late, no ground
is free. Turning on the spot needs no free ground.

The policy computes an occupancy grid of the same depth images. The guard keeps its own: it must
hold whatever another process sends, or fails to send. A look of 320x240 costs it 2 ms of processor
time.
"""

import math
import threading
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from schemas.base import TICK_S, Velocity
from services.robot.body import Body, Kinematics, View
from services.robot.clock import SILENCE_S
from smal.obstacles.capture_time import CaptureTime
from smal.obstacles.clearance import Mount, Surroundings, most_speed

# Age of a depth image after which no ground is free, seconds; equal to that of commands.
MAX_LOOK_S: Final = SILENCE_S
_STEPS: Final = 20  # Number of steps of a share: each change of it is published.


def guard_of(body: Body[View]) -> "Guard | None":
    """Return the guard of a body; None without a depth camera."""
    return (
        None
        if body.mount is None
        else Guard(body.mount, body.kinematics, body.braking_s, body.frame_s)
    )


class _Known:
    """Immutable result of one depth image, with a cache of the free distance by velocity."""

    def __init__(self, around: Surroundings | None, taken_s: float) -> None:
        self._around = around
        self.taken_s = taken_s  # Capture time of the depth image.
        self._free_m = dict[Velocity, float]()
        self.granted = 0.0  # Largest share of the speed that was granted since.

    def free_m(self, velocity: Velocity, kinematics: Kinematics) -> float:
        """Return the free distance along the arc of a velocity at the time of the image."""
        if self._around is None:
            return 0.0
        if velocity not in self._free_m:
            linear, angular = velocity
            bend = angular * kinematics.turn_rate_rad_s / (linear * kinematics.speed_m_s)
            self._free_m[velocity] = self._around.free_m(linear > 0.0, bend)
        return self._free_m[velocity]


class Guard:
    """Bounds the speed of a round robot.

    One thread calls ``look``. Any thread can call ``share``, which never waits for ``look``.
    """

    def __init__(
        self, mount: Mount, kinematics: Kinematics, braking_s: float, frame_s: float = TICK_S
    ) -> None:
        self._mount = mount
        self._kinematics = kinematics
        self._braking_s = braking_s
        self._frame_s = frame_s
        self._around = Surroundings(mount.radius_m)  # Used by ``look`` alone.
        self._capture_time = CaptureTime(mount)
        # Held for the few lines that grant a share, or replace the result.
        self._lock = threading.Lock()
        self._known = self._before = _Known(None, -math.inf)  # The last result, and the one before.

    def look(
        self, depth_m: NDArray[np.float32] | None, pose: Sequence[float], captured_s: float
    ) -> None:
        """Take a depth image, and the odometry pose at its stamp.

        An image can be older than its stamp. It counts as of its estimated time and pose, and is
        ignored if it is too old or shows no ground.
        """
        self._capture_time.note(pose, captured_s)
        if depth_m is None:
            return
        taken_s, there = self._capture_time.estimate(depth_m)
        if captured_s - taken_s > MAX_LOOK_S:
            return
        elapsed_s = taken_s - self._known.taken_s
        if not self._around.observe(there, depth_m, self._mount, elapsed_s):
            return
        known = _Known(self._around.snapshot(), taken_s)
        with self._lock:
            self._before = self._known
            self._known = known

    def sees(self, now_s: float) -> bool:
        """Return whether the depth camera has recently shown the ground."""
        return now_s - self._known.taken_s <= MAX_LOOK_S

    def share(self, velocity: Velocity, now_s: float) -> float:
        """Return the largest safe share of its speed, 0 to 1, along the arc of a velocity."""
        if velocity.linear == 0.0:
            return 1.0
        known = self._known
        speed_m_s = self._kinematics.speed_m_s
        free_m = known.free_m(velocity, self._kinematics)
        with self._lock:
            age_s = now_s - known.taken_s
            if age_s > MAX_LOOK_S:
                return 0.0
            # Distance travelled since the image.
            free_m -= age_s * speed_m_s * max(known.granted, self._before.granted)
            # The robot continues for a frame before its speed can change.
            most = most_speed(free_m, speed_m_s, self._braking_s, self._frame_s)
            share = math.floor(most * _STEPS) / _STEPS
            # A concurrent result is older than this share.
            for one in (known, self._known):
                one.granted = max(one.granted, share)
            return share
