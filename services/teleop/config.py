"""Settings of teleoperation."""

from typing import Annotated, Final

from pydantic import Field

from schemas.episode import GoalName
from services.kit.settings import ServiceSettings

#: Keyboards begin to repeat 0.25 to 0.6 s after the press, and then do every 0.03 to 0.1 s.
FIRST_HOLD_S: Final = 0.6
REPEAT_HOLD_S: Final = 0.15


class TeleopSettings(ServiceSettings):
    """Which episodes to drive, and how the keyboard repeats."""

    seed: Annotated[int | None, Field(ge=0, lt=2**63 - 1_000_000)] = None
    """Seed of the first episode, the next ones count up; drawn at random if not given."""
    goal: GoalName = "victim"
    """Name of the place that the drives lead to."""
    first_hold_s: Annotated[float, Field(gt=0, le=2)] = FIRST_HOLD_S
    """How long the first press of a key counts as held; at least the keyboard's delay before it repeats."""
    repeat_hold_s: Annotated[float, Field(gt=0, le=2)] = REPEAT_HOLD_S
    """How long each repeat counts as held; at least the keyboard's interval between two."""
