"""Whether what takes long is to go on, asked between its steps; whoever does the steps need not know who may end it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Final, TypeVar

T = TypeVar("T")


def _nobody_asks() -> None:
    """Go on."""


_ASK: Final[ContextVar[Callable[[], None]]] = ContextVar("go_on", default=_nobody_asks)


def go_on() -> None:
    """Raise what ends the work of this thread, where somebody wants it to end."""
    _ASK.get()()


def each(items: Iterable[T]) -> Iterator[T]:
    """Give items one after another for as long as the work is to go on."""
    for item in items:
        go_on()
        yield item


@contextmanager
def asking(ask: Callable[[], None]) -> Iterator[None]:
    """Have ``go_on`` call something on this thread, which raises what ends the work."""
    token = _ASK.set(ask)
    try:
        yield
    finally:
        _ASK.reset(token)
