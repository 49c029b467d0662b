"""A robot that only says what it was told: heartbeats, episodes, and a note of every command."""

from __future__ import annotations

from schemas import topics
from schemas.base import Message
from schemas.command import Command, CommandApplied
from schemas.episode import Episode
from schemas.rpc import EndRequest, ResetReply, ResetRequest, ResumeRequest
from services.kit.node import Node, ServiceError
from services.kit.settings import ServiceSettings

BEAT_S = 0.05


class FakeRobot:
    """Takes the part of the simulator on the bus."""

    def __init__(self, settings: ServiceSettings) -> None:
        self.node = Node("simulator", settings)
        self.commands: list[Command] = []
        self.resets: list[ResetRequest] = []
        self.ends: list[str] = []
        self.refuse: str | None = None
        self._episode: str | None = None
        self._tick = 0
        self._stops = self._released = 0
        self.resumed: list[str] = []
        for source in ("teleop", "emergency_stop"):
            self.node.subscribe(topics.COMMANDS[source], self._on_command)
        self.node.serve("resume", ResumeRequest, self._resume)
        self.node.detail = lambda: {"emergency_stop": self._emergency}
        self.node.serve("reset", ResetRequest, self._reset)
        self.node.serve("end", EndRequest, self._end)
        self.node.every(BEAT_S, self._beat)

    def atoms(self, source: str = "teleop") -> list[str]:
        """Return what one source asked for, in order."""
        return [command.atom for command in self.commands if command.source == source]

    def finish(self, outcome: str) -> None:
        """Publish the end of the episode, from any thread."""
        episode, self._episode = self._episode, None
        assert episode is not None
        self.node.publish(self._event(episode, "ended", outcome))

    def _reset(self, request: ResetRequest) -> ResetReply:
        if self.refuse is not None:
            raise ServiceError(self.refuse)
        if self._emergency not in (0, request.release_emergency_stop):
            raise ServiceError("the emergency stop is latched")
        self.resets.append(request)
        self._episode = f"drive-{len(self.resets)}"
        self._tick, self._released = 0, self._stops
        self.node.publish(self._event(self._episode, "started", None))
        return ResetReply(episode=self._episode, world="yard", route=(), speed_m_s=2.0, found_m=5.0)

    @property
    def _emergency(self) -> int:
        return self._stops if self._stops != self._released else 0

    def _resume(self, request: ResumeRequest) -> None:
        self.resumed.append(request.episode)

    def _end(self, request: EndRequest) -> None:
        self.ends.append(request.episode)
        self.finish("aborted")

    def _on_command(self, command: Command) -> None:
        self.commands.append(command)
        self._stops += command.source == "emergency_stop"

    def _beat(self) -> None:
        if self._episode is None:
            return
        self._tick += 1
        last = self.commands[-1] if self.commands else None
        what = {"atom": last.atom, "source": "teleop", "reason": "command"} if last else {}
        if last is None or last.tick < self._tick - 2:
            what = {"atom": "stop", "source": None, "reason": "silence"}
        if self._emergency:
            what = {"atom": "stop", "source": "emergency_stop", "reason": "emergency_stop"}
        self.node.publish(
            CommandApplied.after(self._header(self._episode), speed=1.0, emergency_stop=self._emergency, **what)
        )

    def _event(self, episode: str, name: str, outcome: str | None) -> Episode:
        fields = {"event": name, "purpose": "drive", "driver": "teleop", "world": "yard", "seed": 5}
        return Episode.after(self._header(episode), **fields, outcome=outcome)

    def _header(self, episode: str) -> Message:
        return Message(robot=self.node.robot, episode=episode, tick=self._tick, stamp_ns=1_000_000_000)
