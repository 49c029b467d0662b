"""What stands about the robot, put together of its depth images and its odometry."""

import numpy as np

from schemas.depth_image import DepthImage
from schemas.odometry import Odometry
from smal.clearance import Mount, Surroundings


class Sight:
    """Keeps the surroundings of one episode, of depth images that say how their camera sits, and the wheels."""

    def __init__(self) -> None:
        self._episode = ""
        self._odometry: Odometry | None = None
        self._around: Surroundings | None = None

    def roll(self, odometry: Odometry) -> None:
        """Take where the wheels say that the robot is."""
        if odometry.episode != self._episode:
            self._episode, self._around = odometry.episode, None
        self._odometry = odometry
        if self._around is not None:
            self._around.move((odometry.x_m, odometry.y_m, odometry.heading_rad))

    def see(self, depth: DepthImage) -> None:
        """Take a depth image, if the odometry of its frame is known."""
        now, sits = self._odometry, depth.mounting
        if sits is None or now is None or (now.episode, now.tick) != (depth.episode, depth.tick):
            return
        mount = Mount(**sits.model_dump())
        if self._around is None or self._around.radius_m != mount.radius_m:
            self._around = Surroundings(mount.radius_m)
        pose = now.x_m, now.y_m, now.heading_rad
        self._around.look(pose, (depth.to_numpy() / 1000.0).astype(np.float32), mount)

    def around(self, episode: str) -> Surroundings | None:
        """Return what stands about the robot in an episode; None where no depth has told it."""
        return self._around if episode == self._episode else None
