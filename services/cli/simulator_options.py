"""What a command may say of the simulator that it starts, in one place for all commands that start one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

from services.cli.options import Camera, camera_of_own_stack
from services.cli.stack.processes import flags
from services.kit.errors import UsageError
from services.simulator.opening import BaseKind
from services.simulator.variation import VARIATIONS


@dataclass(frozen=True)
class SimulatorOptions:
    """How the simulator of a stack is started; None leaves a setting at its default.

    Raises
    ------
    UsageError
        When the shake is not from 0 to 10, or no number at all, or base or variation are unknown.
    """

    world: str
    camera: Camera
    shake: float | None = None
    base: str | None = None
    variation: str | None = None

    def __post_init__(self) -> None:
        if self.shake is not None and not 0 <= self.shake <= 10:
            raise UsageError(f"--shake {self.shake:g}: from 0 to 10")
        for option, value, known in (
            ("--base", self.base, get_args(BaseKind)),
            ("--variation", self.variation, VARIATIONS),
        ):
            if value is not None and value not in known:
                raise UsageError(f"{option} {value}: known are {', '.join(known)}")

    def flags(self) -> tuple[str, ...]:
        """Return the simulator's flags."""
        return flags(
            world=self.world,
            camera_width=self.camera.width,
            camera_height=self.camera.height,
            shake=self.shake,
            base=self.base,
            variation=self.variation,
        )


def simulator_of_own_stack(
    world: str,
    camera: str | None,
    connect: str | None,
    *,
    shake: float | None = None,
    base: str | None = None,
    variation: str | None = None,
) -> SimulatorOptions:
    """Read the simulator's options of a command that starts a stack of its own unless it connects to another.

    Raises
    ------
    UsageError
        When one is wrong, or belongs to a stack that runs already.
    """
    size = camera_of_own_stack(camera, connect)
    given = {"--shake": shake, "--base": base, "--variation": variation}
    for option, value in given.items():
        if value is not None and connect is not None:
            raise UsageError(f"{option}: with --connect the running stack's simulator counts; give it to `smal up`")
    return SimulatorOptions(world, size, shake=shake, base=base, variation=variation)
