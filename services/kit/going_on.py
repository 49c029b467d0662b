"""Cancellation of long work between its steps, independent of who cancels it."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Final, TypeVar

T = TypeVar("T")
_ASK: Final[ContextVar[Callable[[], None]]] = ContextVar("go_on", default=lambda: None)


def each(items: Iterable[T]) -> Iterator[T]:
    """Yield the items until the work of this thread is cancelled."""
    for item in items:
        go_on()
        yield item


def go_on() -> None:
    """Raise the error that cancels the work of this thread, if it is cancelled."""
    _ASK.get()()


@contextmanager
def asking(ask: Callable[[], None]) -> Iterator[None]:
    """Set the check of ``each`` on this thread; it raises an error to cancel the work."""
    token = _ASK.set(ask)
    try:
        yield
    finally:
        _ASK.reset(token)
