"""Processing of untrusted files in a child process with limits of memory and time, which can be cancelled.

C libraries read these files. A hostile file can make them crash, loop, or take all memory. That ends the child
process, and becomes a one-line error here.

The time limit is processor time, so that a loaded machine rejects no sound file. It grows with the size of the file,
and restarts at each step that the work reports. So the length of a recording is not limited.
"""

import ctypes
import json
import os
import resource
import selectors
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import IO, Any, Final

#: Environment variable: factor of all limits.
FACTOR: Final = "SMAL_LIMITS"
#: Processor time of a step, seconds, and of each megabyte that it can read. Of sound files, a map of 40,000 houses
#: took longest: 37 s for its 17 MB.
LEAST_S: Final = 30.0
S_A_MEGABYTE: Final = 20.0
# Limit of the wall time over the processor time: a loaded machine, or a slow disk.
_WAITING: Final = 20.0
_TURN_S: Final = 0.1  # Interval at which the parent checks for cancellation, seconds.
_PARENT_DIED: Final = 1  # PR_SET_PDEATHSIG of <linux/prctl.h>.


class ConfinedError(Exception):
    """The work failed; the text contains the file and the reason in one line."""


@dataclass(frozen=True)
class WorkLimits:
    """Maximum memory in bytes, and maximum processor time of the first step in seconds."""

    memory: int
    cpu_s: float

    @classmethod
    def of_size(cls, size: int, memory: int) -> "WorkLimits":
        """Return the limits of work with a source of ``size`` bytes."""
        return cls(memory, LEAST_S + S_A_MEGABYTE * size / 1e6)


class Work:
    """Reports of the work in the child process to its parent."""

    def __init__(self, replies: IO[str], cpu_s: float) -> None:
        self._replies = replies
        self._cpu_s = cpu_s
        self._renew()

    def step(self, name: str, cpu_s: float) -> None:
        """Begin a step with its own limit."""
        self._cpu_s = cpu_s * _factor()
        self.reply(step=name, cpu_s=self._cpu_s)
        self._renew()

    def tell(self, progress: object) -> None:
        """Report progress, which restarts the time of the step."""
        self.reply(progress=progress)
        self._renew()

    def reply(self, **message: object) -> None:
        """Send a message to the parent."""
        self._replies.write(json.dumps(message) + "\n")
        self._replies.flush()

    def _renew(self) -> None:
        spent = resource.getrusage(resource.RUSAGE_SELF)
        until_s = int(spent.ru_utime + spent.ru_stime + self._cpu_s) + 1
        resource.setrlimit(resource.RLIMIT_CPU, (until_s, resource.RLIM_INFINITY))


def confined(
    function: str,
    request: object,
    limits: WorkLimits,
    source: object,
    *,
    progress: Callable[[Any], None] = lambda _: None,
    go_on: Callable[[], None] = lambda: None,
    pass_fds: Sequence[int] = (),
) -> Any:  # noqa: ANN401 - JSON
    """Run a function of ours in a child process.

    Parameters
    ----------
    function : str
        ``module:name`` of the function. It takes the request and a `Work`, and returns JSON. Its `ConfinedError` is
        raised here.
    request : object
        JSON.
    limits : WorkLimits
        Maximum memory and time.
    source : object
        Name of the file for errors.
    progress : callable
        Called with the progress that the function reports.
    go_on : callable
        Called ten times a second; an exception from it ends the work.
    pass_fds : sequence of int
        Open files that the child inherits.

    Raises
    ------
    ConfinedError
        If the function raised it, crashed, or exceeded a limit.
    """
    factor = _factor()
    limits = WorkLimits(int(limits.memory * factor), limits.cpu_s * factor)
    order = {
        "function": function,
        "request": request,
        "memory": limits.memory,
        "cpu_s": limits.cpu_s,
    }
    # Each thread of OpenBLAS counts towards the limit of memory.
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    with subprocess.Popen(  # noqa: S603 - our own
        [sys.executable, "-P", "-m", "smal.files.confined", str(os.getpid())], stdin=subprocess.PIPE,
        stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment, pass_fds=pass_fds,
    ) as child:  # fmt: skip
        try:
            assert child.stdin is not None
            with suppress(BrokenPipeError):
                child.stdin.write(json.dumps(order).encode())
                child.stdin.close()
            return _Listener(child, limits, source).listen(progress, go_on)
        finally:
            child.kill()


class _Listener:
    """Reads the replies of a child process."""

    def __init__(self, child: subprocess.Popen[bytes], limits: WorkLimits, source: object) -> None:
        assert child.stdout is not None
        self._child = child
        self._replies = child.stdout.fileno()
        self._limits = limits
        self._source = source
        self._step = "it"
        self._cpu_s = limits.cpu_s
        self._last: dict[str, Any] = {}

    def listen(self, progress: Callable[[Any], None], go_on: Callable[[], None]) -> Any:  # noqa: ANN401 - JSON
        """Return the result, or raise the error."""
        rest = b""
        heard_s = time.monotonic()
        with selectors.DefaultSelector() as selector:
            selector.register(self._replies, selectors.EVENT_READ)
            while True:
                go_on()
                if selector.select(_TURN_S):
                    if not (data := os.read(self._replies, 2**16)):
                        return self._result()
                    heard_s = time.monotonic()
                    *lines, rest = (rest + data).split(b"\n")
                    for line in lines:
                        self._take(json.loads(line), progress)
                elif time.monotonic() - heard_s > _WAITING * self._cpu_s:
                    raise self._exceeded(f"{_WAITING * self._cpu_s:.0f} s without progress")

    def _take(self, message: dict[str, Any], progress: Callable[[Any], None]) -> None:
        if "step" in message:
            self._step = f"{message['step']} of it"
            self._cpu_s = message["cpu_s"]
        elif "progress" in message:
            progress(message["progress"])
        else:
            self._last = message

    def _result(self) -> Any:  # noqa: ANN401 - JSON
        status = self._child.wait()
        if "result" in self._last:
            return self._last["result"]
        if "error" in self._last:
            raise ConfinedError(self._last["error"])
        if "memory" in self._last:
            raise self._exceeded(f"{self._limits.memory / 2**30:.3g} GiB of memory")
        if status == -signal.SIGXCPU:
            raise self._exceeded(f"{self._cpu_s:.3g} s of processor time")
        raise ConfinedError(
            f"{self._source}: reading it broke down (status {status}); the file is damaged, or hostile"
        )

    def _exceeded(self, bound: str) -> ConfinedError:
        raised = f"{FACTOR}={2 * _factor():g} doubles the limit"
        return ConfinedError(
            f"{self._source}: reading {self._step} takes more than {bound}; if it is sound, {raised}"
        )


def _factor() -> float:
    text = os.environ.get(FACTOR, "1")
    with suppress(ValueError):
        if 1.0 <= (factor := float(text)) <= 1e6:
            return factor
    raise ConfinedError(f"{FACTOR}={text}: must be a number from 1 to 1000000")


def size_of(path: Path) -> int:
    """Return the bytes of a file, or of all files in a folder; holes do not count."""
    files = path.rglob("*") if path.is_dir() else [path]
    total = 0
    for file in files:
        with suppress(OSError):
            total += 512 * file.lstat().st_blocks if path.is_dir() else 512 * file.stat().st_blocks
    return total


def main() -> None:
    """Do the work that the parent sends on standard input."""
    # Ctrl-C is for the parent, which ends this process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PARENT_DIED, ctypes.c_ulong(signal.SIGKILL))
        if os.getppid() != int(sys.argv[1]):
            return
    order = json.load(sys.stdin)
    replies = os.fdopen(os.dup(1), "w")
    # The output of libraries must not disturb the replies.
    os.dup2(2, 1)
    # Mapped files do not count: recordings are larger than this.
    resource.setrlimit(resource.RLIMIT_DATA, (order["memory"], order["memory"]))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    work = Work(replies, order["cpu_s"])
    module, name = order["function"].split(":")
    # From the package: as a program, this file defines a second class of that name.
    refusal = import_module("smal.files.confined").ConfinedError
    try:
        work.reply(result=getattr(import_module(module), name)(order["request"], work))
    except refusal as error:
        work.reply(error=str(error))
    except MemoryError:
        work.reply(memory=True)


if __name__ == "__main__":
    main()
