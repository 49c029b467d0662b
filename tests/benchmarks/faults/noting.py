"""The simulated robot with a gate that notes when it stands for each emergency stop, and is armed again by itself.

What its bus tells of a stop would come late where the bus is flooded, as a call that arms it would.
"""

import json
import math
import os
import time
from functools import partial
from pathlib import Path
from typing import Final
from unittest.mock import patch

from schemas.base import STANDING
from schemas.command import Command
from services.kit.process import run_service
from services.robot.gate import MAX_AGE_S, Applied, CommandGate, Refusal
from services.robot.service import ROBOT
from services.simulator.__main__ import serve

NOTES: Final = "BENCH_STOPS"  # Names the file of the notes, in the environment.
# The robot stands for so long, seconds, then it drives on; five steps of the actuator.
_STANDS_S: Final = 0.1


class NotingGate(CommandGate):
    """A gate that writes a line when a stop is latched, and one when the actuator stands for it.

    It stands since the stop, or since before, for another reason: its lanes are deaf, or its commands are too old.
    """

    def __init__(self, notes: Path, max_age_s: float = MAX_AGE_S, *, attended: bool) -> None:
        super().__init__(max_age_s, attended=attended)
        self._notes = notes.open("a", buffering=1)
        self._latched: int | None = None
        self._stood_s: float | None = None
        self._stands_since_s = time.monotonic()

    def offer(self, command: Command, now_s: float) -> Refusal | None:
        """Take a command, and note a stop."""
        refusal = super().offer(command, now_s)
        if command.source == "emergency_stop":
            self._note(command.sequence, "latched_s", time.monotonic())
            self._latched = command.sequence
        return refusal

    def applied(self, now_s: float, *, deaf: bool = False) -> Applied:
        """Tell the actuator what to do, and note that it stands for a stop."""
        told = super().applied(now_s, deaf=deaf)
        if told.velocity != STANDING:
            self._stands_since_s = math.inf
        self._stands_since_s = min(self._stands_since_s, time.monotonic())
        if told.source == "emergency_stop" and self._latched is not None:
            self._note(self._latched, "stood_s", self._stands_since_s)
            self._latched = None
            self._stood_s = now_s
        elif self._stood_s is not None and now_s - self._stood_s > _STANDS_S:
            self._stood_s = None
            self.arm(self.latched_stop, "")
        return told

    def arm(self, stop: int, session: str) -> str | None:
        """Release a stop, and have the policy drive on."""
        return super().arm(stop, session) or self.resume(None, 0, session)

    def _note(self, stop: int, what: str, at_s: float) -> None:
        self._notes.write(json.dumps([stop, what, at_s]) + "\n")


if __name__ == "__main__":
    with patch("services.robot.service.CommandGate", partial(NotingGate, Path(os.environ[NOTES]))):
        run_service(ROBOT, serve)
