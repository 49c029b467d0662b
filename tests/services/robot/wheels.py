"""A real actuator whose body is a point on a line, and records its orders."""

import time
from dataclasses import dataclass

from schemas.base import Atom, Velocity
from schemas.command import Command, CommandApplied
from schemas.topics import APPLIED
from services.kit.node import Node
from services.kit.settings import ServiceSettings
from services.robot.clock import now_s
from services.robot.gate import CommandGate
from services.robot.loop import check_stopping
from services.robot.runner import EpisodeRunner
from services.robot.service import RobotService
from services.robot.task import OperatorsTask
from tests.services.conftest import RunNode
from tests.services.robot.line import LineBody


class Wheels(LineBody):
    """A body that notes when it was told to move, and when to stand."""

    braking_s = 0.1

    def __init__(self) -> None:
        super().__init__(now_s)
        self.told: list[tuple[float, Atom]] = []

    def drive(self, velocity: Velocity) -> Velocity:
        self.told.append((time.monotonic(), velocity.atom()))
        return super().drive(velocity)

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
    """A robot that runs in the process of the test."""

    wheels: Wheels
    gate: CommandGate


def run_robot(settings: ServiceSettings, run_node: RunNode, *, attended: bool) -> Robot:
    """Run a robot on a line."""
    wheels = Wheels()
    gate = CommandGate(attended=attended)
    check_stopping(wheels)
    node = Node("robot", settings)
    RobotService(EpisodeRunner(wheels, OperatorsTask(), gate, settings.robot, "s"), node)
    run_node(node)
    return Robot(wheels, gate)


class Policy:
    """A policy that drives ahead whatever happens, by the frames that it knows of."""

    def __init__(self, settings: ServiceSettings, run_node: RunNode) -> None:
        self.applied: list[CommandApplied] = []
        self._node = Node("policy", settings)
        self._node.subscribe(APPLIED, self._answer)
        run_node(self._node)

    def _answer(self, applied: CommandApplied) -> Command:
        self.applied.append(applied)
        return Command.after(applied, source="policy", atom="forward")
