"""A runner of the robot on the line, a driver that answers its frames, and time that a test lets pass."""

from collections.abc import Callable, Iterable, Iterator
from typing import Any

from schemas.base import Atom, Message, Source
from schemas.command import Command
from schemas.episode import Episode
from schemas.rpc import ResetRequest
from services.robot.clock import Clocks
from services.robot.gate import CommandGate
from services.robot.lockstep import Lockstep
from services.robot.loop import PERIOD_S
from services.robot.pace import Pace, RealTime
from services.robot.runner import EpisodeRunner
from services.robot.task import Task
from services.simulator.body import SimulatedBody
from services.simulator.sensors.camera import FindVictim, SimulatedView
from services.simulator.simulation import Simulation
from tests.services.robot.line import Clock, LineBody, LineView, Reach

Runner = EpisodeRunner[LineView]


class SteppedRealTime(RealTime[LineView]):
    """Real time by a test's clock: the loop has no thread, and makes a step when the test says so."""

    def begin(self) -> None:
        self.loop.start = lambda: None
        super().begin()


def armed(*, attended: bool = False) -> CommandGate:
    """Return a gate that lets commands through."""
    gate = CommandGate(attended=attended, first_stop=1)
    if not attended:
        assert gate.arm(1, "") is None
    return gate


def runner_of(
    body: LineBody,
    gate: CommandGate | None = None,
    wall_clock_ns: Callable[[], int] = lambda: 5,
    task: Task[LineView] | None = None,
) -> Runner:
    """Return a runner that knows lockstep, and real time by the body's clock."""
    gate = gate or armed()
    paces: dict[str, Callable[[], Pace[LineView]]] = {
        "lockstep": lambda: Lockstep(body, body.clock),
        "realtime": lambda: SteppedRealTime(gate, body, body.clock, lambda: None, runner.frame_s),
    }
    runner: Runner = EpisodeRunner(
        body,
        task or Reach(),
        gate,
        "r",
        "s",
        paces=paces,
        clocks=Clocks(body.clock, wall_clock_ns),
    )
    return runner


def simulated(simulation: Simulation) -> EpisodeRunner[SimulatedView]:
    """Return a runner of a simulated robot, as the simulator's process makes it."""
    body = SimulatedBody(simulation)
    return EpisodeRunner(
        body, FindVictim(), armed(), "rescuebot", "test", paces={"lockstep": lambda: Lockstep(body)}
    )


def begin(body: LineBody, **request: object) -> tuple[Runner, list[Message]]:
    """Begin an episode; return its first messages too."""
    runner = runner_of(body)
    return runner, reset(runner, **request)


def reset(runner: Runner, **request: object) -> list[Message]:
    """Begin another episode."""
    _, messages = runner.reset(ResetRequest.model_validate({"seed": 1} | request))
    return messages


def command(
    runner: Runner,
    atom: Atom = "forward",
    tick: int | None = None,
    sequence: int = 0,
    speed: float = 1.0,
    source: Source = "policy",
    session: str = "",
) -> Command:
    """Return an answer to the last frame, or to another one."""
    run = runner.running
    header = Message(robot="r", episode=run.id, tick=run.tick if tick is None else tick, stamp_ns=0)
    return Command.after(
        header, source=source, session=session, sequence=sequence, atom=atom, speed=speed
    )


def answer(runner: Runner, atom: Atom = "forward", **how: Any) -> list[Message]:
    """Answer a frame with a ``command``; return the messages that follow at once."""
    runner.offer(command(runner, atom, **how))
    return list(runner.poll())


def stepping(runner: Runner, clock: Clock, duration_s: float) -> Iterator[Message]:
    """Let real time pass."""
    end_s = clock.now_s + duration_s
    while clock.now_s < end_s - 1e-9:
        clock.now_s += PERIOD_S
        if runner.running is not None and isinstance(runner.running.pace, RealTime):
            runner.running.pace.loop.step()
        yield from runner.poll()


def advance(runner: Runner, clock: Clock, duration_s: float) -> list[Message]:
    """Let real time pass; return the messages published meanwhile."""
    return list(stepping(runner, clock, duration_s))


def events(messages: Iterable[Message]) -> list[tuple[str, str | None]]:
    """Return the events among messages, with outcomes."""
    return [(m.event, m.outcome) for m in messages if isinstance(m, Episode)]
