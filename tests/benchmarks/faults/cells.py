"""The matrix: every fault, how it is done, and what it may cost."""

import os
import resource
import signal
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Final, Literal

from schemas.topics import KEPT_S, Lane
from services.cli.stack import GROUPED
from services.kit.bus import addresses, host_and_port
from services.kit.echo import DEAF_S, SILENT_S
from services.kit.errors import JobError
from services.recordings.sink import PARTIAL_SUFFIX
from services.table import stack_services
from tests.benchmarks.child import child
from tests.benchmarks.faults.judge import Window
from tests.benchmarks.faults.peers import consume_slowly, drive_by_hand, look_on
from tests.benchmarks.faults.proxy import GROWTH, LATE_S, Harm, link
from tests.benchmarks.faults.rig import LINKED, Rig

_RESTART_S: Final = 40.0
_ROOM: Final = 100_000  # What is left on the full disk, bytes: less than a second of recording.
#: How long an operator looks on, and how long after the last sign of life there is nobody, seconds.
_LOOKS_ON_S: Final = 1.0
#: From the death of a service to the next frame that the loop answers, and from the return of one that was away.
_RESTARTED_S = 15.0
_RECOVERED_S = 1.0
_OUT_S: Final = 3.0  # How long one lane is out, where the process must not end.
_FREEZES_S: Final = (1.0, 3.0, 14.0)
_OUTAGE_S: Final = 20.0
_AT_THE_OTHER_S: Final = 2.5  # Two seconds to the other router, and half a one to the next command.
# A robot waits so long at most for its next command, on a machine with too much to do.
_MOVES_S: Final = 10.0
# Without a new command, of what must not disturb the robot: it stands after half a second.
_UNDISTURBED_S: Final = 1.0


@dataclass(frozen=True)
class Limits:
    """What a cell may cost at most; None is not judged.

    The robot moves ``still_s`` after the last valid command, and after a fault that has to make it stand. The loop
    works again after ``recovery_s``. ``lost_ticks`` frames lack a message in the recording. ``pause_s`` goes by without
    a new command, where the fault must not disturb the robot at all. At ``rate_hz`` come at least camera, pose,
    observation, state and commands.
    """

    still_s: float = 0.5
    recovery_s: float | None = _RECOVERED_S
    lost_ticks: int | None = 0
    pause_s: float | None = None
    rate_hz: float | None = None


@dataclass(frozen=True)
class Cell:
    """One fault: ``harm`` does it to a rig whose robot drives, and returns when it lasted.

    ``watched`` is a service that must be another process, and ready, after the fault. With ``drives_on`` episodes go on
    meanwhile; with ``stands`` the robot has to stand; if ``abandoned`` it may stand already when the fault begins. With
    ``next_episode`` the next episode's recording is judged; what there is of this one's must be readable. The stack
    has so many ``routers``; and so many robots as it has ``instances`` of what runs any number of times, where each has
    to find its victim, whatever is harmed meanwhile.
    """

    name: str
    harm: Callable[[Rig], Window]
    limits: Limits = field(default_factory=Limits)
    watched: str | None = None
    drives_on: bool = False
    stands: bool = False
    abandoned: bool = False
    next_episode: bool = False
    routers: int = 1
    instances: int = 1


@contextmanager
def _timed() -> Iterator[list[float]]:
    times = [time.monotonic()]
    try:
        yield times
    finally:
        times.append(time.monotonic())


def nothing(rig: Rig, seconds: float) -> Window:
    """Do no harm."""
    with _timed() as times:
        rig.hold(seconds)
    return Window(*times)


def kill(rig: Rig, service: str, number: signal.Signals = signal.SIGKILL) -> Window:
    """End the service's process that serves the robot; whoever looks after the stack starts it again, at once."""
    pid = rig.pid(service)
    rig.until(rig.moves, _MOVES_S)
    os.kill(pid, number)
    now_s = time.monotonic()
    return Window(now_s, now_s)


def freeze(rig: Rig, service: str, seconds: float) -> Window:
    """Stop a process for some time."""
    return _frozen(rig, rig.pid(service), seconds)


def link_down(rig: Rig, service: str, seconds: float) -> Window:
    """Let the link of a service forward nothing for some time."""
    return _frozen(rig, rig.links[service].pid, seconds)


def _frozen(rig: Rig, pid: int, seconds: float) -> Window:
    rig.until(rig.moves, _MOVES_S)
    with _timed() as times:
        os.kill(pid, signal.SIGSTOP)
        try:
            rig.hold(seconds)
        finally:
            os.kill(pid, signal.SIGCONT)
    return Window(*times)


def abandon(rig: Rig, slow: bool) -> Window:
    """Kill an operator who looks on, behind a link that is as it should be or has grown slow; then arm the robot."""
    with (
        link(rig.bus.endpoint) as way,
        child("the operator", look_on, rig.bus.robot, way.address) as operator,
    ):

        def noticed() -> bool:
            status = rig.status("robot")
            return status is not None and status.detail.get("operator") is True

        if not rig.until(noticed, _RESTART_S):
            raise JobError("the robot does not hear of its operator")
        rig.hold(_LOOKS_ON_S)
        if slow:
            os.kill(way.pid, signal.SIGUSR1)
            rig.hold(LATE_S / GROWTH)
        begin_s = time.monotonic()
        os.kill(operator.pid, signal.SIGKILL)
        rig.hold(LATE_S + _LOOKS_ON_S)
    rig.resume()
    return Window(begin_s, time.monotonic())


def lose_lane(rig: Rig, harm: Harm, lane: Lane, seconds: float = _OUT_S) -> Window:
    """Harm one lane of the robot for some time."""
    way = rig.links["robot"]
    rig.until(rig.moves, _MOVES_S)
    with _timed() as times:
        way.harm(harm, lane)
        rig.hold(seconds)
        way.mend()
    return Window(*times)


def lose_lane_for_good(rig: Rig, harm: Harm, lane: Lane) -> Window:
    """Harm one lane of the robot until its process has ended."""
    way = rig.links["robot"]
    pid = rig.pid("robot")
    rig.until(rig.moves, _MOVES_S)
    with _timed() as times:
        way.harm(harm, lane)
        ended = rig.until(lambda: rig.stack.pid("robot") != pid, SILENT_S + 2.0 * DEAF_S)
        way.mend()
    if not ended:
        raise JobError("the robot's process has not ended")
    return Window(*times)


def lose_lane_by_hand(
    rig: Rig, whose: Literal["robot", "operator"], harm: Harm, lane: Lane
) -> Window:
    """Harm one lane of the robot, or of the operator who drives it by hand; then have the policy go on."""
    with (
        link(rig.bus.endpoint, batches=True) as own,
        child("the operator", drive_by_hand, rig.bus.robot, own.address),
    ):

        def by_hand() -> bool:
            status = rig.status("robot")
            detail = {} if status is None else status.detail
            return (
                detail.get("taken_over") is True and detail.get("operator") is True and rig.moves()
            )

        if not rig.until(by_hand, _RESTART_S):
            raise JobError("the operator does not drive the robot")
        rig.hold(_LOOKS_ON_S)
        rig.until(rig.moves, _MOVES_S)
        way = own if whose == "operator" else rig.links["robot"]
        begin_s = time.monotonic()
        way.harm(harm, lane)
        rig.hold(_OUT_S)
        way.mend()
    rig.hold(_LOOKS_ON_S)
    rig.resume()
    return Window(begin_s, time.monotonic())


def restart_router(rig: Rig, number: signal.Signals, seconds: float = 0.0) -> Window:
    """End the router; the fault ends when the next one accepts connections, after ``seconds`` or a little more."""
    pid = rig.pid("router")
    rig.supervised = seconds <= 0.0
    rig.until(rig.moves, _MOVES_S)
    with _timed() as times:
        os.kill(pid, number)
        try:
            rig.until(lambda: not _accepts(rig.bus.endpoint), 10.0)
            rig.hold(seconds)
        finally:
            rig.supervised = True
        if not rig.until(lambda: _accepts(rig.bus.endpoint), _RESTART_S):
            raise JobError(f"the router did not come back within {_RESTART_S:.0f} s")
    return Window(*times)


def lose_router(rig: Rig, number: signal.Signals, seconds: float = 0.0) -> Window:
    """Kill or freeze the one of two routers at which all are; then all are at the other, which is the next to go."""
    gone = rig.lost % 2
    pid = rig.stack.pid(("router", "router-2")[gone])
    at = addresses(rig.bus.endpoint)[gone]
    rig.lost += 1
    if number == signal.SIGSTOP:
        return _frozen(rig, pid, seconds)
    rig.until(rig.moves, _MOVES_S)
    os.kill(pid, number)
    now_s = time.monotonic()
    rig.until(lambda: not _accepts(at), 10.0)
    if not rig.until(lambda: _accepts(at), _RESTART_S):
        raise JobError(f"the router did not come back within {_RESTART_S:.0f} s")
    return Window(now_s, now_s)


def _accepts(endpoint: str) -> bool:
    try:
        socket.create_connection(host_and_port(endpoint), timeout=0.2).close()
    except OSError:
        return False
    return True


def fill_disk(rig: Rig, seconds: float) -> Window:
    """Let the recorder's files grow no more; root is not needed for that."""
    pid = rig.pid("recorder")

    def size() -> int:
        return max(
            (path.stat().st_size for path in rig.plan.recordings.glob(f"*{PARTIAL_SUFFIX}")),
            default=0,
        )

    rig.until(
        lambda: size() > _ROOM, 5.0
    )  # The first second of messages: what comes before it is lost by a kill, too.
    before = resource.prlimit(pid, resource.RLIMIT_FSIZE)
    with _timed() as times:
        # Python ignores SIGXFSZ, so a write fails as it does on a full disk, but with EFBIG.
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (size() + _ROOM, before[1]))
        try:
            rig.hold(seconds)
        finally:
            resource.prlimit(pid, resource.RLIMIT_FSIZE, before)
    return Window(*times)


def slow_consumer(rig: Rig, seconds: float) -> Window:
    """Have a client that takes everything and then blocks; meanwhile an episode ends and the next one begins.

    Events of episodes are what a sender waits with until they can be sent on.
    """
    with (
        _timed() as times,
        child("the slow consumer", consume_slowly, rig.bus.robot, rig.bus.endpoint),
    ):
        rig.hold(seconds / 2.0)
        rig.end_episode()
        rig.hold(seconds / 2.0)
    return Window(*times)


def _lanes() -> Iterator[Cell]:
    # The link of a lane takes up to half a second to be made again.
    again = Limits(recovery_s=2.0 * _RECOVERED_S)
    lanes: tuple[tuple[Harm, Lane], ...] = (("cut", "stop"), ("cut", "urgent"), ("deafen", "stop"))
    for how, lane in lanes:
        yield Cell(
            f"{how} {lane} lane of robot",
            partial(lose_lane, harm=how, lane=lane),
            again,
            stands=True,
        )
        for whose in ("robot", "operator") if how == "cut" else ():
            harm = partial(lose_lane_by_hand, whose=whose, harm=how, lane=lane)
            cell = Cell(f"{how} {lane} lane of {whose}, by hand", harm, again, drives_on=True)
            yield replace(cell, stands=whose == "robot", abandoned=whose == "operator")
    for_good = partial(lose_lane_for_good, harm="deafen", lane="stop")
    restarted = Limits(recovery_s=_RESTARTED_S, lost_ticks=1)
    yield Cell("stop lane of robot stays deaf", for_good, restarted, "robot", stands=True)


_UNDISTURBED: Final = Limits(pause_s=_UNDISTURBED_S)
# Messages that a killed process had not handed over are lost: of its own, those of one frame.
_KILLED: Final = Limits(recovery_s=_RESTARTED_S, lost_ticks=1)


def _matrix() -> Iterator[Cell]:
    # On a machine that is busy with other things this is not met either.
    calm = partial(nothing, seconds=5.0)
    yield Cell("no fault", calm, _UNDISTURBED, drives_on=True)
    for service in stack_services():
        if service != "console":
            yield from _of_one(service)
    for name, number, seconds in (
        ("kill -9 router", signal.SIGKILL, 0.0), ("restart router", signal.SIGTERM, 0.0),
        ("router down 20 s", signal.SIGKILL, _OUTAGE_S),
    ):  # fmt: skip
        yield Cell(name, partial(restart_router, number=number, seconds=seconds), watched="router")
    # The loss of one of two routers ends when all clients use the other and the robot has a command.
    gone = Limits(pause_s=_AT_THE_OTHER_S)
    killed = partial(lose_router, number=signal.SIGKILL, seconds=0.0)
    frozen = partial(lose_router, number=signal.SIGSTOP, seconds=5.0)
    yield Cell("kill -9 one router of two", killed, gone, routers=2)
    yield Cell("freeze one router of two", frozen, gone, stands=True, routers=2)
    # Two robots and two instances: the other instance takes the robot over when the first is gone.
    yield Cell("no fault, two instances", calm, _UNDISTURBED, drives_on=True, instances=2)
    for service in GROUPED:
        yield from _of_two(service)
    for service in LINKED:
        harm = partial(link_down, service=service, seconds=_OUTAGE_S)
        yield Cell(f"link of {service} down 20 s", harm, stands=service != "recorder")
    yield from _lanes()
    # Longer than anything is kept: what is lost must stand in the recording.
    longer = partial(link_down, service="recorder", seconds=KEPT_S + 15.0)
    yield Cell(f"link of recorder down {KEPT_S + 15.0:.0f} s", longer, Limits(lost_ticks=None))
    for name, slow in (("kill -9 operator", False), ("kill -9 operator, link grown slow", True)):
        yield Cell(name, partial(abandon, slow=slow), drives_on=True, abandoned=True)
    killed = partial(kill, service="console")
    frozen = partial(freeze, service="console", seconds=3.0)
    yield Cell("kill -9 console", killed, _UNDISTURBED, "console", drives_on=True)
    yield Cell("freeze console 3 s", frozen, _UNDISTURBED, drives_on=True)
    yield Cell("full disk", partial(fill_disk, seconds=5.0), _UNDISTURBED, next_episode=True)
    # Between two episodes there is no command for a moment.
    slow_limits = replace(_UNDISTURBED, pause_s=2 * _UNDISTURBED_S, rate_hz=9.0)
    yield Cell("slow consumer", partial(slow_consumer, seconds=15.0), slow_limits, drives_on=True)


def _of_one(service: str) -> Iterator[Cell]:
    """Yield the faults of a service that has one instance."""
    if service != "router":
        # Features are there again before the robot has to stand.
        stands = service in ("robot", "recognition", "policy")
        harm = partial(kill, service=service)
        yield Cell(f"kill -9 {service}", harm, _KILLED, service, stands=stands)
    chain = ("router", "robot", "features", "recognition", "policy")
    for seconds in _FREEZES_S:
        harm = partial(freeze, service=service, seconds=seconds)
        yield Cell(f"freeze {service} {seconds:.0f} s", harm, stands=service in chain)


def _of_two(service: str) -> Iterator[Cell]:
    """Yield the faults of one of two instances."""
    tracks = service == "tracker"
    limits = _UNDISTURBED if tracks else replace(_KILLED, pause_s=_AT_THE_OTHER_S)
    two = f"one {service} of two"
    restarted = partial(kill, service=service, number=signal.SIGTERM)
    frozen = partial(freeze, service=service, seconds=5.0)
    yield Cell(f"kill -9 {two}", partial(kill, service=service), limits, service, instances=2)
    yield Cell(f"restart {two}", restarted, limits, service, instances=2)
    yield Cell(f"freeze {two}", frozen, limits, stands=not tracks, instances=2)


MATRIX: Final = {cell.name: cell for cell in _matrix()}
#: Stops in a flood, which have a stack and a judgement of their own (`floods`).
FLOODS: Final = (
    "floods",
    "floods with certificates",
    "floods of declarations",
    "floods of declarations with certificates",
)
#: The short version: what tells most in a minute.
QUICK: Final = (
    "no fault",
    "kill -9 policy",
    "kill -9 recorder",
    "freeze recognition 3 s",
    "restart router",
)
