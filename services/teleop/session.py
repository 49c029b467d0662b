"""One session at the keyboard: the terminal on one side, the robot on the other."""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from queue import Empty, SimpleQueue
from typing import Final

from schemas import topics
from schemas.command import CommandApplied
from schemas.episode import Episode
from schemas.rpc import EndRequest, Nothing, ResetReply, ResetRequest, ResumeRequest, Status
from services.kit.bus import RpcError
from services.kit.node import Node
from services.teleop.config import TeleopSettings
from services.teleop.keys import Key, KeyHold, KeyParser
from services.teleop.service import TeleopService
from services.teleop.status import Status as StatusLine
from services.teleop.terminal import Terminal, open_terminal

#: How often keys are read, releases noticed and the status line drawn.
POLL_S: Final = 0.02
CONNECT_S: Final = 3.0
#: The simulator's first frame takes seconds.
RESET_S: Final = 60.0
END_S: Final = 5.0
HELP: Final = "arrows or w a s d: drive (hold)   space: stop   e: EMERGENCY STOP   n: new episode   r: resume   q: quit"


def run(settings: TeleopSettings) -> None:
    """Drive until the operator quits or the process is told to stop."""
    with Node("teleop", settings, CONNECT_S) as node, open_terminal() as terminal:
        node.stop_on_signals()
        session = TeleopSession(node, terminal, settings)
        terminal.say(HELP)
        node.spin()
        session.finish()


class TeleopSession:
    """Wires keys, commands and status line to a node; everything happens on the node's thread.

    Parameters
    ----------
    node
        Where to publish.
    terminal
        Where the operator sits.
    settings
        Seed and timing of keys.
    clock
        Monotonic seconds.
    """

    def __init__(
        self,
        node: Node,
        terminal: Terminal,
        settings: TeleopSettings,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._node = node
        self._terminal = terminal
        self._parser = KeyParser()
        self._service = TeleopService(KeyHold(clock, settings.first_hold_s, settings.repeat_hold_s), node.robot)
        self._status = StatusLine(clock)
        self._seed = secrets.randbelow(2**31) if settings.seed is None else settings.seed
        self._goal = settings.goal
        self._mine: str | None = None
        self._resetting: threading.Thread | None = None
        self._replies: SimpleQueue[ResetReply | RpcError] = SimpleQueue()
        self._complaints: SimpleQueue[str] = SimpleQueue()
        node.subscribe(topics.APPLIED, self.on_applied)
        node.subscribe(topics.EPISODE, self.on_event)
        node.every(POLL_S, self.poll)

    def on_applied(self, applied: CommandApplied) -> None:
        """Answer the robot's heartbeat."""
        self._node.publish(self._service.handle(applied))
        self._status.on_applied(applied)

    def on_event(self, event: Episode) -> None:
        """Follow the episode."""
        self._service.on_event(event)
        self._terminal.say(self._status.on_event(event))
        if event.event == "ended" and event.episode == self._mine:
            self._mine = None

    def poll(self) -> None:
        """Read the keys, notice releases and replies, and draw the status line."""
        typed = self._terminal.read()
        if typed is None:
            self._node.stop()
            return
        for key in self._parser.feed(typed):
            self._press(key)
        self._node.publish(self._service.poll())
        self._take_reply()
        with suppress(Empty):
            self._terminal.say(self._complaints.get_nowait())
        self._terminal.show(self._status.line(self._service.held, self._service.emergency))

    def finish(self) -> None:
        """Stop the robot, and end the episode that was begun here, so that its recording is complete."""
        self._node.publish(self._service.release())
        if self._resetting is not None:
            self._terminal.say("waiting for the episode that was asked for, to end it")
            self._resetting.join(RESET_S)
            self._take_reply()
        if self._mine is not None:
            try:
                self._node.bus.call("simulator", "end", EndRequest(episode=self._mine), Nothing, END_S)
            except RpcError as error:
                self._terminal.say(str(error))

    def _press(self, key: Key) -> None:
        if key == "quit":
            self._node.stop()
        elif key == "new_episode":
            self._begin_episode()
        elif key == "resume":
            self._resume()
        elif key == "emergency_stop":
            self._node.publish(self._service.stop_for_emergency())
            self._terminal.say("EMERGENCY STOP until you begin a new episode (n)")
        else:
            self._node.publish(self._service.press(key))

    def _resume(self) -> None:
        """Ask that the driver goes on from whom the operator has taken over, without waiting for the answer."""
        if self._service.episode is None or self._service.held is not None:
            self._terminal.say("no episode" if self._service.held is None else "let go of the key first")
            return
        request = ResumeRequest(episode=self._service.episode, tick=self._service.heard.tick)

        def resume() -> None:
            try:
                self._node.bus.call("simulator", "resume", request, Nothing, END_S)
            except RpcError as error:
                self._complaints.put(str(error))

        threading.Thread(target=resume, name="resume", daemon=True).start()

    def _begin_episode(self) -> None:
        """Ask the simulator in a thread of its own: an emergency stop must not wait for a slow reset."""
        if self._resetting is not None:
            self._terminal.say("still waiting for the simulator")
            return
        request = ResetRequest(seed=self._seed, purpose="drive", goal=self._goal, driver="teleop", mode="realtime")
        self._service.release_emergency_stop()
        self._seed += 1
        # Only a person who looks at the robot may release an emergency stop: the one that they know of when they press
        # the key. Heartbeats tell its number; without an episode there are none, and nothing that moves.
        seen = None if self._service.applied is None else self._service.applied.emergency_stop
        stops = self._service.stops

        def reset() -> None:
            bus = self._node.bus
            try:
                stop = self._latched() if seen is None else seen
                if self._service.stops != stops:
                    raise RpcError("an emergency stop came meanwhile; press n again to release it")
                released = request.model_copy(update={"release_emergency_stop": stop})
                self._replies.put(bus.call("simulator", "reset", released, ResetReply, RESET_S))
            except Exception as error:  # noqa: BLE001 - else no further episode could ever be asked for
                self._replies.put(error if isinstance(error, RpcError) else RpcError(str(error)))

        self._terminal.say(f"new episode, seed {request.seed} ...")
        self._status.on_request()
        self._resetting = threading.Thread(target=reset, name="reset", daemon=True)
        self._resetting.start()

    def _latched(self) -> object:
        status = self._node.bus.call("simulator", "status", Nothing(), Status, END_S)
        return status.detail.get("emergency_stop", 0)

    def _take_reply(self) -> None:
        try:
            reply = self._replies.get_nowait()
        except Empty:
            return
        self._resetting = None
        if isinstance(reply, RpcError):
            self._service.keep_emergency_stop()
            self._terminal.say(str(reply))
            self._status.on_failure()
        else:
            self._mine = reply.episode
