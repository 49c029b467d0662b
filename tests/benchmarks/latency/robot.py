"""A robot that relives a recorded drive: frames and odometry in real time, the actuator's gate, and no wheels."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from schemas import topics
from schemas.base import Message
from schemas.command import Command, CommandApplied
from schemas.compressed_image import CompressedImage
from schemas.episode import Episode, EventName, Outcome
from schemas.odometry import Odometry
from services.kit.jpeg import encode_jpeg
from services.kit.node import Node
from services.kit.settings import ServiceSettings
from services.robot.clock import TICK_S
from services.robot.gate import CommandGate

#: Longer than any command stays fresh.
_LAST_ANSWER_S: Final = 1.0
#: The services take the episode's first message, and their first frame, from rest.
_PREPARE_S: Final = 0.5


#: Pose of each frame by the wheels: x, y in metres, heading in radians.
Way = list[tuple[float, float, float]]


class Robot:
    """Stands in for the simulator, without the rendering."""

    def __init__(self, settings: ServiceSettings) -> None:
        self.node = Node("bench", settings)
        self._gate = CommandGate(first_stop=1)
        self._gate.arm(1, "")
        self._sent_s: dict[int, float] = {}
        self._taken_s: dict[int, float] = {}
        self._header = Message(robot=settings.robot, episode="none", tick=0, stamp_ns=0)
        self.node.subscribe(topics.COMMANDS["policy"], self._on_command, depth=256)

    def drive(
        self, episode: str, frames: list[NDArray[np.uint8]], way: Way, on_tick: Callable[[], object]
    ) -> list[float | None]:
        """Show the frames, each at its time from the beginning on, and take the commands meanwhile.

        Returns
        -------
        list
            Seconds from before each frame was made a JPEG to the acceptance of its command; None where there was none.
        """
        self._sent_s, self._taken_s = {}, {}
        self._gate.begin(episode, "policy")
        self._step(episode, 0)
        self.node.publish(self._event("started"))
        start_s = time.monotonic() + _PREPARE_S
        for tick, (pixels, pose) in enumerate(zip(frames, way, strict=True)):
            due_s = start_s + tick * TICK_S
            self.node.spin(timeout_s=max(0.001, due_s - time.monotonic()))
            self._step(episode, tick)
            self._show(tick, pixels, pose)
            on_tick()
        self.node.spin(timeout_s=_LAST_ANSWER_S)
        self.node.publish(self._event("ended", "aborted"))
        return [self._taken_s.get(tick) for tick in range(len(frames))]

    def _show(self, tick: int, pixels: NDArray[np.uint8], pose: tuple[float, float, float]) -> None:
        height, width, _ = pixels.shape
        now_s = self._sent_s[tick] = time.monotonic()
        self._gate.captured(tick, now_s)
        x_m, y_m, heading_rad = pose
        self.node.publish(
            Odometry.after(self._header, x_m=x_m, y_m=y_m, heading_rad=heading_rad, speed_m_s=0.0, turn_rate_rad_s=0.0)
        )
        self.node.publish(CompressedImage.after(self._header, width=width, height=height, data=encode_jpeg(pixels)))
        applied = self._gate.applied(time.monotonic())
        self.node.publish(
            CommandApplied.after(
                self._header, atom=applied.atom, speed=applied.speed, source=applied.source, reason=applied.reason,
                answered_tick=applied.answered_tick,
            )
        )  # fmt: skip

    def _step(self, episode: str, tick: int) -> None:
        self._header = Message(robot=self.node.robot, episode=episode, tick=tick, stamp_ns=time.time_ns())

    def _event(self, name: EventName, outcome: Outcome | None = None) -> Episode:
        return Episode.after(
            self._header, event=name, purpose="run", driver="policy", world="bench", seed=0, outcome=outcome
        )

    def _on_command(self, command: Command) -> None:
        now_s = time.monotonic()
        if self._gate.offer(command, now_s) is None:
            self._taken_s.setdefault(command.tick, now_s - self._sent_s[command.tick])

    def close(self) -> None:
        """Leave the bus."""
        self.node.close()
