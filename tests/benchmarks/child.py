"""Processes of a benchmark's own: started, waited for, and ended with their context."""

import multiprocessing
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import Any, Final, NamedTuple

from services.kit.errors import JobError

_STARTING_S: Final = 600.0
_STOPPING_S: Final = 2.0


class Child(NamedTuple):
    """A process: its id, what it sent first, and our end of its pipe."""

    pid: int
    said: Any
    pipe: Connection


@contextmanager
def child(name: str, run: Callable[..., None], *arguments: object) -> Iterator[Child]:
    """Run a function in a new process.

    Parameters
    ----------
    name : str
        For errors, for example "the receiver".
    run : callable
        Called with the arguments and its end of a pipe. It sends something when it is ready, and ends when the pipe is
        closed; else it is killed.
    """
    spawn = multiprocessing.get_context("spawn")
    ours, theirs = spawn.Pipe()
    process = spawn.Process(target=_run, args=(run, *arguments, theirs))
    process.start()
    theirs.close()
    try:
        if not ours.poll(_STARTING_S):
            raise JobError(f"{name} did not start")
        try:
            said = ours.recv()
        except EOFError:
            raise JobError(f"{name} has ended") from None
        assert process.pid is not None
        yield Child(process.pid, said, ours)
    finally:
        ours.close()
        process.join(_STOPPING_S)
        process.kill()
        process.join()


def _run(run: Callable[..., None], *arguments: object) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the owner
    run(*arguments)
