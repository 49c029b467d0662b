"""What stands about the robot, put together of its depth images and its odometry."""

import numpy as np

from schemas.camera import DepthImage
from schemas.motion import Odometry
from smal.obstacles.clearance import Mount, Surroundings


class ObstacleSight:
    """Keeps the surroundings of one episode, of depth images that say how their camera sits, and the wheels."""

    def __init__(self) -> None:
        self._odometry: Odometry | None = None
        self._depth: DepthImage | None = None
        self.mount: Mount | None = None  # How the depth camera sits.
        self._around: tuple[str, Surroundings] | None = None

    def roll(self, odometry: Odometry) -> None:
        """Take where the wheels say that the robot is."""
        self._odometry = odometry

    def see(self, depth: DepthImage) -> None:
        """Take a depth image."""
        self._depth = depth

    def around(self, episode: str) -> Surroundings | None:
        """Return what stands about the robot now, by the newest of both; None where no depth has told it."""
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
        # Where the image is of another frame, only the wheels tell something.
        image = (depth.to_numpy() / 1000.0).astype(np.float32) if depth.tick == now.tick else None
        self._around[1].look((now.x_m, now.y_m, now.heading_rad), image, mount)
        return self._around[1]
