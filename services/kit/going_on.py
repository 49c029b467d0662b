"""Whether what takes long is to go on, asked between its steps; whoever does the steps need not know who may end it."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Final, TypeVar

T = TypeVar("T")
_ASK: Final[ContextVar[Callable[[], None]]] = ContextVar("go_on", default=lambda: None)


def each(items: Iterable[T]) -> Iterator[T]:
    """Give items one after another for as long as the work of this thread is to go on."""
    for item in items:
        go_on()
        yield item


def go_on() -> None:
    """Raise what ends the work of this thread if it is not to go on."""
    _ASK.get()()


@contextmanager
def asking(ask: Callable[[], None]) -> Iterator[None]:
    """Have ``each`` call something on this thread, which raises what ends the work."""
    token = _ASK.set(ask)
    try:
        yield
    finally:
        _ASK.reset(token)
