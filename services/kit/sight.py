"""Occupancy around the robot, from depth images and odometry."""

import numpy as np

from schemas.camera import DepthImage
from schemas.motion import Odometry
from smal.obstacles.clearance import Mount, Surroundings


class ObstacleSight:
    """Surroundings of one episode, from depth images with a mounting and odometry."""

    def __init__(self) -> None:
        self._odometry: Odometry | None = None
        self._depth: DepthImage | None = None
        self.mount: Mount | None = None  # Position of the depth camera.
        self._around: tuple[str, Surroundings] | None = None
        self._stamp_ns = 0  # Of the odometry at the last look.

    def roll(self, odometry: Odometry) -> None:
        """Store the pose by odometry."""
        self._odometry = odometry

    def see(self, depth: DepthImage) -> None:
        """Store a depth image."""
        self._depth = depth

    def around(self, episode: str) -> Surroundings | None:
        """Return the current surroundings; None without a depth image of the episode."""
        now = self._odometry
        depth = self._depth
        if (
            now is None
            or depth is None
            or depth.mounting is None
            or not episode == now.episode == depth.episode
        ):
            return None
        self.mount = mount = Mount(**depth.mounting.model_dump())
        if self._around is None or self._around[0] != episode:
            self._around = episode, Surroundings(mount.radius_m)
        # If the image belongs to another frame, only the odometry is used.
        image = (depth.to_numpy() / 1000.0).astype(np.float32) if depth.tick == now.tick else None
        elapsed_s = (now.stamp_ns - self._stamp_ns) / 1e9
        self._stamp_ns = now.stamp_ns
        self._around[1].look((now.x_m, now.y_m, now.heading_rad), image, mount, elapsed_s)
        return self._around[1]
