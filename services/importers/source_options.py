"""What a user may wish of a reader."""

from __future__ import annotations

from pydantic import Field

from schemas.base import Strict


class Wishes(Strict):
    """How to read a source."""

    camera: str | None = None
    """Which camera, by the source's own name: a topic, or a feature."""
    velocity: str | None = None
    """Which velocities, by the source's own names."""
    rate_hz: float | None = Field(default=None, gt=0.0, le=1000.0)
    """Frames a second, for a source whose times are wrong or missing."""
    speed: float | None = Field(default=None, gt=0.0, le=1000.0)
    """Metres a second that the number 1 of the source stands for."""
    turn_rate: float | None = Field(default=None, gt=0.0, le=1000.0)
    """Radians a second that the number 1 of the source stands for."""
    episodes: tuple[str, ...] = ()
    """Which drives, by the source's own names; all if empty."""
