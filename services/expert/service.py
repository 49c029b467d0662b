"""The expert as a client: pose and observation of a frame in, one command out."""

from __future__ import annotations

from schemas.command import Command
from schemas.observation import Observation
from schemas.pose import Pose
from schemas.rpc import ResetReply
from services.expert.driver import RouteDriver
from services.kit.errors import JobError


class ExpertService:
    """Commands once for every frame, after that frame has been through the features service.

    Having arrived it commands nothing more: the client ends the episode, and with a last command under way at the
    same time chance would decide how many frames the episode has.

    Waiting for the observation keeps a lockstep demonstration from outrunning what it is meant to record.
    """

    def __init__(self) -> None:
        self._episode = ""
        self._driver: RouteDriver | None = None
        self._pose: Pose | None = None
        self._observation: Observation | None = None
        self._last: Command | None = None
        self.arrived = False

    def begin(self, reset: ResetReply) -> None:
        """Take up the route of an episode that begins. Raises JobError where nobody knows the way."""
        if reset.found_m is None or len(reset.route) < 2:
            raise JobError(f"{reset.world}: nobody knows the way there; demonstrate it by hand, with smal teleop")
        self._episode = reset.episode
        self._driver = RouteDriver(reset.route, reset.speed_m_s, reset.found_m)
        self._pose = self._observation = None
        self._last = None
        self.arrived = False

    def see(self, pose: Pose) -> Command | None:
        """Take the pose of a frame; the two topics of a frame may arrive in either order."""
        self._pose = pose
        return self._answer()

    def handle(self, observation: Observation) -> Command | None:
        """Take the observation of a frame, and return the key to hold once its pose is known too."""
        self._observation = observation
        return self._answer()

    def _answer(self) -> Command | None:
        pose, observation = self._pose, self._observation
        if pose is None or observation is None or self._driver is None or self.arrived:
            return None
        if (pose.episode, pose.tick) != (observation.episode, observation.tick) or pose.episode != self._episode:
            return None
        if self._last is None or self._last.tick != pose.tick:
            # Otherwise the simulator asked again, because the command was lost on the way: the same answer.
            self.arrived = self._driver.arrived(pose.x_m, pose.y_m)
            if self.arrived:
                return None
            atom = self._driver.key(pose.x_m, pose.y_m, pose.heading_rad)
            self._last = Command.after(pose, source="expert", atom=atom)
        return self._last
