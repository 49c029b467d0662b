"""End of a process that lacks memory, and time limit for the cleanup of a process that fails.

When memory is exhausted, Zenoh's threads panic and Python's threads end silently. Therefore a
process ends while it still has a reserve for its cleanup.
"""

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from mmap import MAP_ANONYMOUS, MAP_PRIVATE, mmap
from typing import Final

#: Minimum available memory of a process, bytes: twice the block size of glibc and Zenoh.
_RESERVE: Final = 8 << 20
# Time limit of the cleanup, seconds: more than a node waits for its threads.
_ENDING_S: Final = 15
_services: list[object] = []  # Services of this process; empty in a command or a test.


def check_memory() -> None:
    """Raise OSError (ENOMEM) if the reserve is unavailable; takes microseconds."""
    mmap(-1, _RESERVE, flags=MAP_PRIVATE | MAP_ANONYMOUS).close()


@contextmanager
def service_process() -> Iterator[None]:
    """Enable `ends_soon` for this process.

    Disable Zenoh's backtraces: without memory they deadlock with all of Python (Rust 1.93).
    """
    os.environ["RUST_BACKTRACE"] = "0"
    _services.append(None)
    try:
        yield
    finally:
        _services.pop()
        signal.alarm(0)


@contextmanager
def ends_soon() -> Iterator[None]:
    """Limit the cleanup of a service after an error to `_ENDING_S`.

    Failed threads can hold locks that the cleanup waits for. An alarm needs neither memory nor a
    thread.
    """
    try:
        yield
    except BaseException:
        if _services:
            signal.alarm(_ENDING_S)
        raise
