"""A robot that only says what it was told: heartbeats, episodes, and a note of everything it hears.

Its stops are those of the real gate; but it misses nobody, so that a busy machine changes nothing.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from schemas import topics
from schemas.base import NO_EPISODE, Message
from schemas.command import Command, CommandApplied
from schemas.episode import Episode
from schemas.heartbeat import Heartbeat
from schemas.pulse import Pulse
from schemas.rpc import ArmRequest, EndRequest, ResetReply, ResetRequest, ResumeRequest
from services.kit.node import Detail, Node, ServiceError
from services.kit.settings import ServiceSettings
from services.robot.clock import PULSE_S
from services.robot.gate import CommandGate

BEAT_S = 0.05


def nothing() -> None:
    """Take no time."""


class FakeRobot:
    """Takes the part of the robot on the bus."""

    def __init__(self, settings: ServiceSettings) -> None:
        self.node = Node("robot", settings)
        self.gate = CommandGate(first_stop=1)
        self.commands: list[Command] = []
        self.heard_s: list[float] = []
        self.beats: list[Heartbeat] = []
        self.arms: list[int] = []
        self.resets: list[ResetRequest] = []
        self.resumed: list[ResumeRequest] = []
        self.ends: list[EndRequest] = []
        #: What happens when it is asked, before and after it does so.
        self.before_arm: Callable[[], None] = nothing
        self.before_reset: Callable[[], None] = nothing
        self._episode: str | None = None
        self._tick = 0
        for source in ("teleop", "emergency_stop"):
            self.node.at_once(topics.COMMANDS[source], self._on_command)
        self.node.at_once(topics.HEARTBEAT, self._on_beat)
        self.node.serve("arm", ArmRequest, self._arm)
        self.node.serve("reset", ResetRequest, self._reset)
        self.node.serve("resume", ResumeRequest, self._resume)
        self.node.serve("end", EndRequest, self._end)
        self.node.detail = self._detail
        self.node.every(BEAT_S, self._beat)
        self.node.apart(PULSE_S, self._pulse)

    def atoms(self, source: str = "teleop") -> list[str]:
        """Return what one source asked for, in order."""
        return [command.atom for command in self.commands if command.source == source]

    def finish(self, outcome: str) -> None:
        """Publish the end of the episode, from any thread."""
        episode, self._episode = self._episode, None
        assert episode is not None
        self.node.publish(self._event(episode, "ended", outcome))

    def _detail(self) -> Detail:
        return {
            "episode": self._episode,
            "emergency_stop": self.gate.emergency_stop,
            "stop_cause": self.gate.stop_cause,
            "taken_over": self._episode is not None,
        }

    def _arm(self, request: ArmRequest) -> None:
        self.arms.append(request.stop)
        self.before_arm()
        refusal = self.gate.arm(request.stop, request.session)
        if refusal is not None:
            raise ServiceError(refusal)

    def _reset(self, request: ResetRequest) -> ResetReply:
        self.before_reset()
        if self.gate.emergency_stop:
            raise ServiceError("a stop is latched")
        self.resets.append(request)
        self._episode = f"drive-{len(self.resets)}"
        self._tick = 0
        self.node.publish(self._event(self._episode, "started", None))
        return ResetReply(episode=self._episode, world="yard", route=(), speed_m_s=2.0, found_m=5.0)

    def _resume(self, request: ResumeRequest) -> None:
        self.resumed.append(request)

    def _end(self, request: EndRequest) -> None:
        self.ends.append(request)
        self.finish("found" if request.found else "aborted")

    def _on_beat(self, beat: Heartbeat) -> None:
        self.beats.append(beat)
        self.gate.hear(beat, time.monotonic())

    def _on_command(self, command: Command) -> None:
        if command.source == "emergency_stop":
            self.gate.stop()
        self.heard_s.append(time.monotonic())
        self.commands.append(command)

    def _beat(self) -> None:
        if self._episode is None:
            return
        self._tick += 1
        last = self.commands[-1] if self.commands else None
        what = {"atom": last.atom, "source": "teleop", "reason": "command"} if last else {}
        if last is None or last.tick < self._tick - 2:
            what = {"atom": "stop", "source": None, "reason": "silence"}
        stop = self.gate.emergency_stop
        if stop:
            what = {"atom": "stop", "source": None, "reason": "emergency_stop", "stop_cause": self.gate.stop_cause}
        self.node.publish(CommandApplied.after(self._header(self._episode), speed=1.0, emergency_stop=stop, **what))

    def _pulse(self) -> Pulse:
        gate = self.gate
        said = {"number": gate.pulse(time.monotonic()), "emergency_stop": gate.emergency_stop}
        return Pulse.after(self._header(self._episode or NO_EPISODE), session="s", stop_cause=gate.stop_cause, **said)

    def _event(self, episode: str, name: str, outcome: str | None) -> Episode:
        fields = {"event": name, "purpose": "drive", "driver": "teleop", "world": "yard", "seed": 5}
        return Episode.after(self._header(episode), **fields, outcome=outcome)

    def _header(self, episode: str) -> Message:
        return Message(robot=self.node.robot, episode=episode, tick=self._tick, stamp_ns=1_000_000_000)
