"""Signals that end a command."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Final

_ENDING: Final = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)


@contextmanager
def interrupted_by_signals() -> Iterator[None]:
    """Convert SIGTERM and SIGHUP to KeyboardInterrupt, so that children are stopped as well.

    SIGHUP stays ignored under ``nohup``. Only the first signal interrupts, so that the cleanup can
    finish; Ctrl-C always interrupts.
    """
    before = {number: signal.getsignal(number) for number in _ENDING}

    def on_signal(_number: int, _frame: FrameType | None) -> None:
        for number in (signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN)
        raise KeyboardInterrupt

    for number in _ENDING:
        if number != signal.SIGHUP or before[number] is not signal.SIG_IGN:
            signal.signal(number, on_signal)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
