"""The faults themselves: each does its harm, lets it last, and heals it; and tells when it was."""

from __future__ import annotations

import os
import resource
import signal
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from services.kit.bus import host_and_port
from services.kit.errors import JobError
from services.recordings.sink import PARTIAL_SUFFIX
from tests.benchmarks.faults.judge import Window
from tests.benchmarks.faults.operator import looking_on
from tests.benchmarks.faults.proxy import GROWTH, LATE_S, link
from tests.benchmarks.faults.rig import Rig
from tests.benchmarks.faults.slow import slow_consumer

_RESTART_S: Final = 40.0
#: What is left on the full disk, bytes: less than a second of recording.
_ROOM: Final = 100_000
#: Debian's package libfaketime.
FAKETIME: Final = tuple(Path("/usr/lib").glob("*/faketime/libfaketimeMT.so.1"))
#: How long an operator looks on, and how long after the last sign of life there is nobody, seconds.
_LOOKS_ON_S: Final = 1.0
#: How soon a process with libfaketime looks at its file again, seconds.
_NOTICED_S: Final = 1.0


def nothing(rig: Rig, seconds: float) -> Window:
    """Do no harm."""
    with _timed() as times:
        rig.hold(seconds)
    return Window(*times)


def kill(rig: Rig, service: str) -> Window:
    """Kill a service; whoever looks after the stack starts it again. The fault ends at once."""
    os.kill(rig.pid(service), signal.SIGKILL)
    now_s = time.monotonic()
    return Window(now_s, now_s)


def freeze(rig: Rig, service: str, seconds: float) -> Window:
    """Stop a process for some time."""
    return _frozen(rig, rig.pid(service), seconds)


def link_down(rig: Rig, service: str, seconds: float) -> Window:
    """Let the link of a service forward nothing for some time."""
    return _frozen(rig, rig.links[service], seconds)


def abandon(rig: Rig, slow: bool) -> Window:
    """Kill an operator who looks on, behind a link that is as it should be or has grown slow; then arm the robot."""
    with link(rig.bus.endpoint) as (address, link_pid), looking_on(rig.bus.robot, address) as operator_pid:
        if not rig.until(lambda: rig.detail().get("operator") is True, _RESTART_S):
            raise JobError("the robot does not hear of its operator")
        rig.hold(_LOOKS_ON_S)
        if slow:
            os.kill(link_pid, signal.SIGUSR1)
            rig.hold(LATE_S / GROWTH)
        begin_s = time.monotonic()
        os.kill(operator_pid, signal.SIGKILL)
        rig.hold(LATE_S + _LOOKS_ON_S)
    rig.resume()
    return Window(begin_s, time.monotonic())


def _frozen(rig: Rig, pid: int, seconds: float) -> Window:
    begin_s = time.monotonic()
    os.kill(pid, signal.SIGSTOP)
    try:
        rig.hold(seconds)
    finally:
        os.kill(pid, signal.SIGCONT)
    return Window(begin_s, time.monotonic())


def restart_router(rig: Rig, number: signal.Signals, seconds: float = 0.0) -> Window:
    """End the router; the fault ends when the next one accepts connections, after ``seconds`` or a little more."""
    pid = rig.pid("router")
    rig.supervised = seconds <= 0.0
    begin_s = time.monotonic()
    os.kill(pid, number)
    try:
        rig.until(lambda: not _accepts(rig.bus.endpoint), 10.0)
        rig.hold(seconds)
    finally:
        rig.supervised = True
    if not rig.until(lambda: _accepts(rig.bus.endpoint), _RESTART_S):
        raise JobError(f"the router did not come back within {_RESTART_S:.0f} s")
    return Window(begin_s, time.monotonic())


def _accepts(endpoint: str) -> bool:
    try:
        socket.create_connection(host_and_port(endpoint), timeout=0.2).close()
    except OSError:
        return False
    return True


def fill_disk(rig: Rig, seconds: float) -> Window:
    """Let the recorder's files grow no more; root is not needed for that."""
    pid = rig.pid("recorder")
    size = max((path.stat().st_size for path in rig.plan.recordings.glob(f"*{PARTIAL_SUFFIX}")), default=0)
    before = resource.prlimit(pid, resource.RLIMIT_FSIZE)
    begin_s = time.monotonic()
    # Python ignores SIGXFSZ, so a write fails as it does on a full disk, but with EFBIG.
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (size + _ROOM, before[1]))
    try:
        rig.hold(seconds)
    finally:
        resource.prlimit(pid, resource.RLIMIT_FSIZE, before)
    return Window(begin_s, time.monotonic())


def clock_environment(file: Path) -> dict[str, str]:
    """Return the environment of processes whose wall clock a file sets; the monotonic clock is let alone."""
    file.write_text("+0")
    return {
        "LD_PRELOAD": str(FAKETIME[0]),
        "FAKETIME_TIMESTAMP_FILE": str(file),
        "FAKETIME_CACHE_DURATION": f"{_NOTICED_S:.0f}",
        "FAKETIME_DONT_FAKE_MONOTONIC": "1",
        "DONT_FAKE_MONOTONIC": "1",
    }


def jump(rig: Rig, offset_s: int) -> Window:
    """Set the wall clock of all services, compared with the true one."""
    begin_s = time.monotonic()
    file = Path(rig.plan.environment["FAKETIME_TIMESTAMP_FILE"])
    # Never empty in between: that would be read as no offset.
    new = file.with_suffix(".new")
    new.write_text(f"{offset_s:+d}")
    new.replace(file)
    rig.hold(_NOTICED_S)
    return Window(begin_s, time.monotonic())


def consume_slowly(rig: Rig, seconds: float) -> Window:
    """Have a client that takes everything and then blocks; meanwhile an episode ends and the next one begins.

    Events of episodes are what a sender waits with until they can be sent on.
    """
    with _timed() as times, slow_consumer(rig.bus.robot, rig.bus.endpoint):
        rig.hold(seconds / 2.0)
        rig.end_episode()
        rig.hold(seconds / 2.0)
    return Window(*times)


@contextmanager
def _timed() -> Iterator[list[float]]:
    times = [time.monotonic()]
    yield times
    times.append(time.monotonic())
