"""Settings of the tracker."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from services.kit.settings import ServiceSettings


class TrackerSettings(ServiceSettings):
    """Which tag lies on the robot, and how; the defaults are the TurtleBot's."""

    tag_number: Annotated[int, Field(ge=0, le=49)] = 7
    """Number of the ArUco marker in DICT_4X4_50."""
    tag_side_m: Annotated[float, Field(gt=0, le=10)] = 0.2
    """Side of the marker's black square, metres."""
    tag_height_m: Annotated[float, Field(ge=0, le=10)] = 0.43
    """Height of the marker above the floor, metres."""
