"""The simulator on the bus: calls and commands in, frames and episode events out."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from schemas.base import Message
from schemas.command import Command, CommandApplied
from schemas.episode import Episode
from schemas.rpc import EndRequest, ResetReply, ResetRequest, ResumeRequest
from schemas.topics import COMMANDS
from services.kit.node import Detail, Node, ServiceError
from services.simulator.base import STEP_S
from services.simulator.episode import EpisodeRunner

LATCHED: Final = "emergency stop {} is latched; release it with a new episode from smal teleop (n)"
TAKEN_OVER: Final = "a person has taken over; let the driver go on from smal teleop (r)"


class SimulatorService:
    """Wires an ``EpisodeRunner`` to a node.

    Parameters
    ----------
    runner
        The simulated robot.
    node
        Where to serve; every handler runs on its thread, which is also the one that renders.
    """

    def __init__(self, runner: EpisodeRunner, node: Node) -> None:
        self._runner = runner
        self._node = node
        self._timed: tuple[str, int | None] | None = None
        for source, topic in COMMANDS.items():
            if source != "emergency_stop":
                node.subscribe(topic, self.handle)
        # On the bus's own thread: nothing that waits or renders goes before it, and no queue can lose it.
        node.at_once(COMMANDS["emergency_stop"], self.stop)
        node.serve("reset", ResetRequest, self.reset)
        node.serve("end", EndRequest, self.end)
        node.serve("resume", ResumeRequest, self.resume)
        node.every(STEP_S, self.poll)
        node.detail = self.detail

    def stop(self, _: Command) -> None:
        """Latch an emergency stop; the next poll tells of it."""
        self._runner.gate.stop()

    def handle(self, command: Command) -> Iterator[Message]:
        """Offer a command to the actuator."""
        yield from self._log(self._runner.offer(command))

    def poll(self) -> None:
        """Let time pass."""
        self._node.publish(self._log(self._runner.poll()))

    def reset(self, request: ResetRequest) -> ResetReply:
        """Begin an episode; refused while an emergency stop is latched that the request does not release."""
        latched = self._runner.gate.emergency_stop
        if latched and latched != request.release_emergency_stop:
            raise ServiceError(LATCHED.format(latched))
        if self._runner.gate.taken_over and request.driver != "teleop":
            raise ServiceError(TAKEN_OVER)
        # Whatever becomes of the next one, the running episode ends here.
        self._node.publish(self._log(iter(self._runner.end(None))))
        reply, messages = self._runner.reset(request)
        self._node.publish(self._log(iter(messages)))
        return reply

    def end(self, request: EndRequest) -> None:
        """End the running episode."""
        running = self._runner.running
        if running is None or running.id != request.episode:
            raise ServiceError(f"episode {request.episode} is not running")
        self._node.publish(self._log(iter(self._runner.end(None))))

    def resume(self, request: ResumeRequest) -> None:
        """Let the driver go on, from whom a person has taken over."""
        if not self._runner.gate.resume(request.episode, request.tick):
            raise ServiceError("another episode has begun, or the person has commanded since")
        self._node.log.info("episode %s: the driver goes on", request.episode)

    def detail(self) -> Detail:
        """Tell the running episode and how the actuator fares."""
        running = self._runner.running
        detail: Detail = {
            "world": self._runner.world_name,
            "episode": running.id if running else None,
            "tick": running.tick if running else None,
            "slow_ticks": self._runner.slow_ticks,
            "resent": self._runner.resent,
            "emergency_stop": self._runner.gate.emergency_stop,
            "taken_over": self._runner.gate.taken_over,
        }
        # This runs on a thread of the bus: list() takes the counts at one moment.
        detail |= {f"refused {reason}": count for reason, count in list(self._runner.gate.refused.items())}
        return detail

    def _log(self, messages: Iterator[Message]) -> Iterator[Message]:
        for message in messages:
            if isinstance(message, Episode):
                outcome = f": {message.outcome}" if message.outcome else ""
                self._node.log.info("episode %s, frame %d: %s%s", message.episode, message.tick, message.event, outcome)
            elif isinstance(message, CommandApplied):
                self._time(message)
            yield message

    def _time(self, applied: CommandApplied) -> None:
        """Count how long a command took, once: what is applied is said again with every frame."""
        answered = (applied.episode, applied.answered_tick)
        if applied.source is None or applied.latency_ns is None or answered == self._timed:
            return
        self._timed = answered
        self._node.metrics.decision(applied.source, applied.latency_ns / 1e9)
