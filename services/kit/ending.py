"""When a process that cannot get memory ends, and how long a process that cannot go on may take to end.

Once memory is gone, Zenoh's threads panic, and Python's threads end without a word. So a process ends while it has a
reserve to tidy up with.
"""

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from mmap import MAP_ANONYMOUS, MAP_PRIVATE, mmap
from typing import Final

#: Memory that a process must be able to get at any time, bytes: twice the blocks by which glibc and Zenoh ask for more.
_RESERVE: Final = 8 << 20
_ENDING_S: Final = (
    15  # Time to tidy up after an error, seconds: more than a node waits for its threads.
)
_services: list[
    object
] = []  # Services that this process runs: one, and none in a command or a test.


def check_memory() -> None:
    """Raise OSError (ENOMEM) if the system, or a limit of this process, refuses the reserve; takes microseconds."""
    mmap(-1, _RESERVE, flags=MAP_PRIVATE | MAP_ANONYMOUS).close()


@contextmanager
def service_process() -> Iterator[None]:
    """Let `ends_soon` end this process.

    Zenoh prints no stack when it panics without memory: that would wait for ever, with all of Python (Rust 1.93).
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
    """Have the kernel end the process of a service that has not tidied up `_ENDING_S` after an error.

    Threads that failed may hold what tidying up waits for. An alarm takes neither memory nor a thread.
    """
    try:
        yield
    except BaseException:
        if _services:
            signal.alarm(_ENDING_S)
        raise
