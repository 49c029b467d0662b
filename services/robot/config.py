"""Settings of whatever moves a robot."""

from __future__ import annotations

from services.kit.settings import ServiceSettings


class RobotSettings(ServiceSettings):
    """Who has to be there for the robot to move."""

    attended: bool = True
    """Whether it moves only while an operator is there, at smal teleop or another console that sends heartbeats. Where
    one is there they are missed in any case: without their heartbeat the robot stands."""
