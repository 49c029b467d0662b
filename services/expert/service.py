"""The expert as a client: pose and observation of a frame in, one command out."""

from __future__ import annotations

from collections.abc import Sequence

from schemas.command import Command
from schemas.observation import Observation
from schemas.pose import Pose
from services.expert.driver import RouteDriver


class ExpertService:
    """Commands once for every frame, after that frame has been through the features service.

    Waiting for the observation keeps a lockstep demonstration from outrunning what it is meant to record.
    """

    def __init__(self) -> None:
        self._episode = ""
        self._driver: RouteDriver | None = None
        self._poses: dict[int, Pose] = {}
        self._last: Command | None = None
        self.arrived = False

    def begin(self, episode: str, route: Sequence[tuple[float, float]]) -> None:
        """Take up the route of an episode."""
        self._episode = episode
        self._driver = RouteDriver(route)
        self._poses.clear()
        self._last = None
        self.arrived = False

    def see(self, pose: Pose) -> None:
        """Remember where the robot was at a frame."""
        if pose.episode == self._episode:
            self._poses[pose.tick] = pose

    def handle(self, observation: Observation) -> Command | None:
        """Return the key for the frame that this observation was made from."""
        if observation.episode != self._episode or self._driver is None:
            return None
        if self._last is not None and observation.tick == self._last.tick:
            # The simulator asked again: the command was lost on the way.
            return self._last
        pose = self._poses.pop(observation.tick, None)
        if pose is None:
            return None
        self.arrived = self._driver.arrived(pose.x_m, pose.y_m)
        atom = self._driver.key(pose.x_m, pose.y_m, pose.heading_rad)
        self._last = Command.after(observation, source="expert", atom=atom)
        return self._last
