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
    EndRequest,
    LookReply,
    Nothing,
    ResetReply,
    ResetRequest,
    ResumeRequest,
    Status,
)
from schemas.topics import COMMANDS, HEARTBEAT, PULSE, Lane
from services.kit.bus import RpcError
from services.kit.jpeg import decode_jpeg, encode_jpeg, jpeg_size, shrunk
from services.kit.node import Detail, Node, ServiceError
from services.kit.settings import ServiceSettings
from services.robot import radio
from services.robot.body import Body, View
from services.robot.clock import CLOCKS, PULSE_S, Clocks
from services.robot.gate import MAX_AGE_S, CommandGate
from services.robot.loop import ECHO_S, PERIOD_S, check_stopping
from services.robot.pace import Paces
from services.robot.runner import EpisodeRunner
from services.robot.task import OperatorsTask, Task

ROBOT: Final = "robot"  # Name on the bus, whatever body it has.
PEEK_COLUMNS: Final = (
    640  # Of what is seen between episodes: so small that a reply takes it, whatever camera it is.
)
ANSWER_S: Final = 1.0  # How long another robot of this id may take to say so.
MOVING: Final[tuple[Lane, ...]] = (
    "urgent",
    "stop",
)  # Lanes without which nobody can move the robot, or stop it.
V = TypeVar("V", bound=View)


class RobotSettings(ServiceSettings):
    """Who has to be there for the robot to move, and what its link to who drives it is like."""

    attended: bool = True
    """Whether it moves only while an operator is there, at smal teleop or another console that sends heartbeats. Where
    one is there they are missed in any case: without their heartbeat the robot stands."""
    frames_hz: Annotated[float, Field(ge=1, le=10)] = 10.0
    """Camera frames a second in real time, at most; fewer for a machine that is too small for its robots. A depth
    camera is too old to drive by below 4."""
    radio: bool = False
    """Whether who drives is at the other end of Wi-Fi: a command may be 0.5 s old, pictures are sent as JPEG of quality
    30, and no more than three are under way that are not answered."""
    jpeg_quality: Annotated[int, Field(ge=1, le=100)] | None = None
    """Quality at which pictures are sent; as the camera gives them, or what is said of radio, if not given."""


def check_alone(settings: ServiceSettings, instead: str = "give this one another id") -> None:
    """Refuse to be a second robot of one id, with a ServiceError that says what its user can do instead."""
    with closing(settings.open_bus(ROBOT)) as bus, suppress(RpcError):
        other = bus.call(ROBOT, "status", Nothing(), Status, ANSWER_S)
        raise ServiceError(
            f"robot {settings.robot} is there already (process {other.pid}); {instead}"
        )


class RobotService:
    """Wires an ``EpisodeRunner`` to a node.

    Commands, signs of life and what cancels are judged on the bus's own thread: nothing that waits or renders goes
    before them, and no queue can lose an emergency stop. Pulses are sent on a thread of their own: an operator is
    missed for their silence, and not for that of a robot which opens a world or takes long for a picture. Everything
    else happens on the node's thread, which renders as well.
    """

    def __init__(self, runner: EpisodeRunner[V], node: Node) -> None:
        self._runner = runner
        self._node = node
        self._timed: tuple[str, int | None] | None = None
        self.left = False  # Whether another robot of this id is there, to which it is left.
        runner.wake = node.soon(self.poll)
        node.bus.echo_every(PULSE_S)
        runner.deaf = lambda: node.bus.echo_age_s(*MOVING) > ECHO_S
        for source, topic in COMMANDS.items():
            # Whoever may send a stop may send nonsense in its place; a flood of that must not keep the stop away.
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
        node.every(PERIOD_S, self.poll)
        node.apart(PULSE_S, runner.pulse)
        node.detail = self.detail

    def take(self, command: Command) -> None:
        """Offer a command to the gate; what comes of it is told by the next poll."""
        self._runner.offer(command)
        self._runner.wake()

    def meet(self, pulse: Pulse) -> None:
        """Leave the robot to another process of its id, where both have been started in the same instant.

        A robot that is armed stays; of two that stand for a stop, as every one does that was just started, one leaves.
        """
        mine = self._runner.session
        stands = self._runner.gate.emergency_stop
        if pulse.session != mine and stands and (not pulse.emergency_stop or pulse.session < mine):
            self.left = True
            self._node.stop()

    def stop(self) -> None:
        """Stop for an emergency that was not put into the form of a command."""
        self._runner.gate.stop()
        self._runner.wake()

    def poll(self) -> None:
        """Let time pass."""
        self._publish(self._runner.poll())

    def arm(self, request: ArmRequest) -> None:
        """Release a latched stop."""
        cause = self._runner.gate.stop_cause
        self._runner.arm(request)
        self._node.log.info("armed (it stood for: %s)", cause)

    def reset(self, request: ResetRequest) -> ResetReply:
        """Begin an episode."""
        self._runner.check_reset(request)
        # Whatever becomes of the next one, the running episode ends here.
        self._publish(self._runner.end())
        reply, messages = self._runner.reset(request)
        self._publish(messages)
        return reply

    def cancel(self, request: CancelRequest) -> None:
        """Begin no episode after all; on the bus's own thread, since the node's is busy with its beginning."""
        self._runner.cancel(request)
        self._node.log.info("the episode that is being begun is cancelled")

    def end(self, request: EndRequest) -> None:
        """End the running episode."""
        self._publish(self._runner.end_by(request))

    def look(self, _: Nothing) -> LookReply:
        """Show what the camera sees before an episode."""
        jpeg = None if self._runner.running else self._runner.body.peek()
        if jpeg is not None and (jpeg_size(jpeg) or (0, 0))[0] > PEEK_COLUMNS:
            jpeg = encode_jpeg(shrunk(decode_jpeg(jpeg), PEEK_COLUMNS))
        return LookReply(picture=jpeg)

    def resume(self, request: ResumeRequest) -> None:
        """Let the driver go on, from whom a person has taken over."""
        self._runner.resume(request)
        self._node.log.info("episode %s: the driver goes on", request.episode)

    def detail(self) -> Detail:
        """Tell the running episode and how the actuator fares."""
        running = self._runner.running
        gate = self._runner.gate
        moves = self._runner.body.kinematics
        detail: Detail = {
            "world": self._runner.body.name,
            "speed_m_s": moves.speed_m_s,
            "turn_rate_rad_s": moves.turn_rate_rad_s,
            "episode": running.id if running else None,
            "tick": running.tick if running else None,
            "emergency_stop": gate.emergency_stop,
            "stop_cause": gate.stop_cause,
            "taken_over": gate.taken_over,
            "attended": gate.attended,
            "operator": gate.operator is not None,
            "judge": "operator" if isinstance(self._runner.task, OperatorsTask) else "task",
        }
        if running is not None:
            detail |= running.pace.detail()
        detail |= self._runner.body.detail()
        # This runs on a thread of the bus: list() takes the counts at one moment.
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
        """Count how long a command took, once: what is applied is said again with every frame."""
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
    """Drive a body until stopped; the task says that the goal is reached.

    When no other robot of this id is there, ``open_body`` makes the body, and how time passes for it in other modes
    than real time. Raises ServiceError where another process is this robot, or the body cannot stand in time.
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
            # Episode ids stay unique when the robot is started again, whatever the wall clock says.
            secrets.token_hex(6),
            paces=paces,
            clocks=clocks,
        )
        runner.frame_s = 1.0 / settings.frames_hz
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
