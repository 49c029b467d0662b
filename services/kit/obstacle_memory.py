"""Occupancy around the robot, from depth images and odometry."""

import numpy as np

from schemas.camera import DepthImage
from schemas.motion import Odometry
from smal.arrays import Float32s
from smal.obstacles.clearance import Mount, Surroundings
from smal.robot import surroundings


class ObstacleMemory:
    """Surroundings of one episode, from odometry, and from depth images with a mounting."""

    def __init__(self) -> None:
        self._odometry: Odometry | None = None
        self._depth: DepthImage | None = None
        self.mount: Mount | None = None  # Position of the depth camera.
        self._episode = ""
        self._around: Surroundings | None = None
        self._stamp_ns = 0  # Stamp of the odometry at the last look.

    def store_odometry(self, odometry: Odometry) -> None:
        """Store the pose by odometry."""
        self._odometry = odometry

    def store_depth(self, depth: DepthImage) -> None:
        """Store a depth image."""
        self._depth = depth

    def around(self, episode: str, radius_m: float = 0.0) -> Surroundings | None:
        """Return the current surroundings; None without odometry of the episode.

        ``radius_m`` is the radius of a robot without a depth camera, metres. If it is 0, the
        surroundings begin with a depth image.
        """
        now = self._odometry
        if now is None or episode != now.episode:
            return None
        if episode != self._episode:
            self._episode = episode
            self._around = None
        elapsed_s = now.since(self._stamp_ns) or 0.0
        self._stamp_ns = now.stamp_ns
        self._around = surroundings(self._around, now.pose, self._seen(now), elapsed_s, radius_m)
        return self._around

    def _seen(self, now: Odometry) -> tuple[Float32s | None, Mount] | None:
        """Return the depth image of a pose, and its mount; no image if it belongs to another frame."""
        depth = self._depth
        if depth is None or depth.mounting is None or depth.episode != now.episode:
            return None
        self.mount = Mount(**depth.mounting.model_dump())
        image = (depth.to_numpy() / 1000.0).astype(np.float32) if depth.tick == now.tick else None
        return image, self.mount
