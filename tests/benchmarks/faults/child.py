"""Processes of the benchmark's own, beside the stack: started, waited for, and ended with their context."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final

from services.kit.errors import JobError

_STARTING_S: Final = 30.0
_STOPPING_S: Final = 2.0


@contextmanager
def child(name: str, run: Callable[..., None], *arguments: object, patience_s: float = _STOPPING_S) -> Iterator[Any]:
    """Run a function in a new process; give the process id, and what it sent first.

    Parameters
    ----------
    name : str
        For errors, for example "the observer".
    run : callable
        Called with the arguments and a pipe. It sends something when it is ready, and ends when the pipe is closed.
    patience_s : float
        How long it may take to end before it is killed; 0 for one that cannot end by itself.
    """
    spawn = multiprocessing.get_context("spawn")
    ours, theirs = spawn.Pipe()
    process = spawn.Process(target=run, args=(*arguments, theirs), daemon=True)
    process.start()
    theirs.close()
    try:
        if not ours.poll(_STARTING_S):
            raise JobError(f"{name} did not start")
        try:
            said = ours.recv()
        except EOFError:
            raise JobError(f"{name} has ended") from None
        yield process.pid, said
    finally:
        ours.close()
        process.join(patience_s)
        process.kill()
        process.join()
