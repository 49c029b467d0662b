"""Occupancy around the robot, from depth images and odometry."""

import numpy as np

from schemas.camera import DepthImage
from schemas.motion import Odometry
from smal.obstacles.clearance import Mount, Surroundings
from smal.robot import surroundings


class ObstacleSight:
    """Surroundings of one episode, from depth images with a mounting and odometry."""

    def __init__(self) -> None:
        self._odometry: Odometry | None = None
        self._depth: DepthImage | None = None
        self.mount: Mount | None = None  # Position of the depth camera.
        self._episode = ""
        self._around: Surroundings | None = None
        self._stamp_ns = 0  # Stamp of the odometry at the last look.

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
        if episode != self._episode:
            self._episode = episode
            self._around = None
        # If the image belongs to another frame, only the odometry is used.
        image = (depth.to_numpy() / 1000.0).astype(np.float32) if depth.tick == now.tick else None
        elapsed_s = now.since(self._stamp_ns) or 0.0
        self._stamp_ns = now.stamp_ns
        self.mount = Mount(**depth.mounting.model_dump())
        self._around = surroundings(self._around, now.pose, (image, self.mount), elapsed_s)
        return self._around
