"""A real actuator whose body is a point on a line, and notes what it is told."""

from __future__ import annotations

import time
from dataclasses import dataclass

from schemas.base import Atom
from services.robot.clock import now_s
from services.robot.gate import CommandGate
from tests.services.robot.line import LineBody


class Wheels(LineBody):
    """A body that notes when it was told to move, and when to stand."""

    braking_s = 0.1

    def __init__(self) -> None:
        super().__init__(now_s)
        self.told: list[tuple[float, Atom]] = []

    def drive(self, atom: Atom, speed: float) -> None:
        super().drive(atom, speed)
        self.told.append((time.monotonic(), atom))

    @property
    def driven(self) -> bool:
        return bool(self.told) and self.told[-1][1] != "stop"

    @property
    def stands_s(self) -> float:
        """When it stood, after it was last told to move."""
        last = max(at for at, (_, atom) in enumerate(self.told) if atom != "stop")
        return self.told[last + 1][0] + self.braking_s


@dataclass(frozen=True)
class Robot:
    """A robot that moves only while an operator is there."""

    wheels: Wheels
    gate: CommandGate
