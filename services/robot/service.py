"""The robot on the bus: calls and commands in, frames and episode events out."""

import secrets
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, suppress
from typing import Annotated, Final, TypeVar

from pydantic import Field

from schemas.base import Message
from schemas.command import Command, CommandApplied
from schemas.episode import Episode
from schemas.heartbeat import Pulse
from schemas.rpc import (
    ArmRequest,
    CancelRequest,
    CarryRequest,
    EndRequest,
    LookReply,
    Nothing,
    ResetReply,
    ResetRequest,
    ResumeRequest,
    Status,
    TaskRequest,
)
from schemas.topics import COMMANDS, HEARTBEAT, PULSE, Lane
from services.kit.bus import RpcError
from services.kit.jpeg import decode_jpeg, encode_jpeg, jpeg_size, shrunk
from services.kit.node import Detail, Node, ServiceError
from services.kit.settings import ServiceSettings
from services.robot import radio
from services.robot.body import Body, Carriable, View
from services.robot.clock import ABSENT_S, CLOCKS, PULSE_S, Clocks
from services.robot.gate import MAX_AGE_S, CommandGate
from services.robot.loop import PERIOD_S, check_stopping
from services.robot.pace import Paces
from services.robot.runner import EpisodeRunner
from services.robot.task import OperatorsTask, Task

# Name on the bus, for any body.
ROBOT: Final = "robot"
# Maximum width of the image between episodes, so that it fits into a reply.
PEEK_COLUMNS: Final = 640
ANSWER_S: Final = 1.0  # Timeout for the answer of another robot with this id.
# Lanes that are needed to move the robot and to stop it.
MOVING: Final[tuple[Lane, ...]] = (
    "urgent",
    "stop",
)
V = TypeVar("V", bound=View)


class RobotSettings(ServiceSettings):
    """Operator presence and link settings."""

    attended: bool = True
    """Whether the robot moves only while an operator is present, at smal teleop or another console
    that sends heartbeats. If an operator is present, the robot stops without their heartbeat in
    any case.
    """
    frames_hz: Annotated[float, Field(ge=1, le=10)] | None = None
    """Maximum camera frames a second in real time, by default the body's own (10); lower it for a
    small machine. Below 4, depth images are too old to drive.
    """
    radio: bool = False
    """Whether the driver is connected by Wi-Fi: commands are valid for 0.5 s, images are JPEG of
    quality 30, and at most three images are unanswered.
    """
    jpeg_quality: Annotated[int, Field(ge=1, le=100)] | None = None
    """JPEG quality of published images; by default that of the camera, or of radio mode."""


def check_alone(settings: ServiceSettings, instead: str = "give this one another id") -> None:
    """Raise ServiceError if another robot has this id; ``instead`` is the advice to the user."""
    with closing(settings.open_bus(ROBOT)) as bus, suppress(RpcError):
        other = bus.call(ROBOT, "status", Nothing(), Status, ANSWER_S)
        raise ServiceError(
            f"robot {settings.robot} already exists (process {other.pid}); {instead}"
        )


class RobotService:
    """Connects an ``EpisodeRunner`` to a node.

    Commands, heartbeats and cancellations run on the bus's own thread: no rendering delays them,
    and no queue can lose an emergency stop. Pulses have a separate thread, so that an operator
    keeps answering while the robot opens a world or renders. The rest runs on the node's thread,
    which also renders.
    """

    def __init__(self, runner: EpisodeRunner[V], node: Node) -> None:
        self._runner = runner
        self._node = node
        self._timed: tuple[str, int | None] | None = None
        self.left = False  # Whether this process gives way to another robot with this id.
        runner.wake = node.soon(self.poll)
        node.bus.echo_every(PULSE_S)
        runner.deaf = lambda: node.bus.echo_age_s(*MOVING) > ABSENT_S
        for source, topic in COMMANDS.items():
            # A sender of stops can also send invalid ones; even a flood of those must stop the
            # robot.
            node.at_once(
                topic, self.take, self.stop if source == "emergency_stop" else lambda: None
            )
        node.at_once(HEARTBEAT, runner.hear)
        node.at_once(PULSE, self.meet)
        node.serve("arm", ArmRequest, self.arm)
        node.serve("reset", ResetRequest, self.reset)
        node.serve("cancel", CancelRequest, self.cancel, at_once=True)
        node.serve("resume", ResumeRequest, self.resume)
        node.serve("end", EndRequest, self.end)
        node.serve("look", Nothing, self.look)
        node.serve("carry", CarryRequest, runner.carry)
        node.serve("task", TaskRequest, runner.choose_task)
        node.every(PERIOD_S, self.poll)
        node.apart(PULSE_S, runner.pulse)
        node.detail = self.detail

    def take(self, command: Command) -> None:
        """Offer a command to the gate; the next poll reports its effect."""
        self._runner.offer(command)
        self._runner.wake()

    def meet(self, pulse: Pulse) -> None:
        """Give way to another process with the same id, if both started in the same instant.

        An armed robot stays. Of two robots with a latched stop, as all have at their start, one
        leaves.
        """
        mine = self._runner.session
        stands = self._runner.gate.latched_stop
        if pulse.session != mine and stands and (not pulse.latched_stop or pulse.session < mine):
            self.left = True
            self._node.stop()

    def stop(self) -> None:
        """Stop for an emergency stop that is not a valid command."""
        self._runner.gate.stop()
        self._runner.wake()

    def poll(self) -> None:
        """Advance the time."""
        self._publish(self._runner.poll())

    def arm(self, request: ArmRequest) -> None:
        """Release a latched stop."""
        cause = self._runner.gate.stop_cause
        self._runner.arm(request)
        self._node.log.info("armed (stop cause: %s)", cause)

    def reset(self, request: ResetRequest) -> ResetReply:
        """Begin an episode."""
        self._runner.check_reset(request)
        # The running episode ends even if the next one fails to begin.
        self._publish(self._runner.end())
        reply, messages = self._runner.reset(request)
        self._publish(messages)
        return reply

    def cancel(self, request: CancelRequest) -> None:
        """Cancel an episode that is beginning; on the bus's thread, since the node's is busy."""
        self._runner.cancel(request)
        self._node.log.info("the beginning of the episode is cancelled")

    def end(self, request: EndRequest) -> None:
        """End the running episode."""
        self._publish(self._runner.end_by(request))

    def look(self, _: Nothing) -> LookReply:
        """Return the camera image between two episodes, and the pose of a simulated robot."""
        if self._runner.running:
            return LookReply()
        body = self._runner.body
        jpeg = body.peek()
        if jpeg is not None and (jpeg_size(jpeg) or (0, 0))[0] > PEEK_COLUMNS:
            jpeg = encode_jpeg(shrunk(decode_jpeg(jpeg), PEEK_COLUMNS))
        return LookReply(picture=jpeg, pose=body.pose if isinstance(body, Carriable) else None)

    def resume(self, request: ResumeRequest) -> None:
        """Return control to the driver after a person took over."""
        self._runner.resume(request)
        self._node.log.info("episode %s: the driver continues", request.episode)

    def detail(self) -> Detail:
        """Return the running episode and the state of the actuator."""
        running = self._runner.running
        gate = self._runner.gate
        moves = self._runner.body.kinematics
        detail: Detail = {
            "world": self._runner.body.name,
            "speed_m_s": moves.speed_m_s,
            "turn_rate_rad_s": moves.turn_rate_rad_s,
            "frames_hz": round(1.0 / self._runner.frame_s, 1),
            "episode": running.id if running else None,
            "tick": running.tick if running else None,
            "latched_stop": gate.latched_stop,
            "stop_cause": gate.stop_cause,
            "fault": self._runner.fault,
            "taken_over": gate.taken_over,
            "attended": gate.attended,
            "operator": gate.operator is not None,
            "judge": "operator" if isinstance(self._runner.task, OperatorsTask) else "task",
        }
        if running is not None:
            detail |= running.pace.detail()
        detail |= self._runner.body.detail()
        # This runs on a thread of the bus: list() copies the counts atomically.
        detail |= {f"refused {reason}": count for reason, count in list(gate.refused.items())}
        return detail

    def _publish(self, messages: Iterable[Message]) -> None:
        self._node.publish(self._log(iter(messages)))

    def _log(self, messages: Iterator[Message]) -> Iterator[Message]:
        for message in messages:
            if isinstance(message, Episode):
                outcome = f": {message.outcome}" if message.outcome else ""
                self._node.log.info(
                    "episode %s, frame %d: %s%s",
                    message.episode,
                    message.tick,
                    message.event,
                    outcome,
                )
            elif isinstance(message, CommandApplied):
                self._time(message)
            yield message

    def _time(self, applied: CommandApplied) -> None:
        """Record the latency of a command once, since each frame repeats the report."""
        answered = (applied.episode, applied.answered_tick)
        if applied.source is None or applied.latency_ns is None or answered == self._timed:
            return
        self._timed = answered
        self._node.metrics.took("decision", applied.source, applied.latency_ns / 1e9)


def serve_robot(
    settings: RobotSettings,
    open_body: Callable[[Node], tuple[Body[V], Paces[V]]],
    task: Task[V],
    *,
    clocks: Clocks = CLOCKS,
) -> None:
    """Drive a body until stopped.

    Parameters
    ----------
    settings
        Settings of the robot.
    open_body
        Creates the body and its paces besides real time; called when no other robot has this id.
    task
        Judge of the goal.
    clocks
        Clocks of the robot.

    Raises
    ------
    ServiceError
        If another process is this robot, or the body cannot stop in time.
    """
    check_alone(settings)
    with Node(ROBOT, settings) as node:
        node.stop_on_signals()
        body, paces = open_body(node)
        check_stopping(body)
        runner = EpisodeRunner(
            body,
            task,
            CommandGate(radio.AGE_S if settings.radio else MAX_AGE_S, attended=settings.attended),
            settings.robot,
            # Keeps episode ids unique after a restart, whatever the wall clock.
            secrets.token_hex(6),
            paces=paces,
            clocks=clocks,
        )
        if settings.frames_hz is not None:
            runner.frame_s = max(1.0 / settings.frames_hz, body.frame_s)
        runner.radio = settings.radio
        runner.jpeg_quality = settings.jpeg_quality or (radio.QUALITY if settings.radio else None)
        service = RobotService(runner, node)
        try:
            node.spin()
        finally:
            node.publish(runner.end())
        if service.left:
            raise ServiceError(
                f"another robot {settings.robot} has been started; give this one another id"
            )
