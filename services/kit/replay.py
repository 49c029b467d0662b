"""Merge of a sender's kept samples with its live samples, in order and without duplicates.

Zenoh's own subscriber with history loses all fetched samples when a live sample arrives between the
ends of its first and second query; the second is for late senders. (Zenoh 1.10.2; under load this
affects every second start of a subscriber to a dozen topics.) Therefore this module fetches the
samples itself.
"""

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, Generic, TypeVar

T = TypeVar("T")

#: Number of remembered senders; there is one at a time, and another after each restart.
_KNOWN: Final = 64


class Budget:
    """Limit of the bytes held by all who share it; thread-safe."""

    def __init__(self, most: int) -> None:
        self._left = most
        self._lock = threading.Lock()

    def take(self, size: int) -> bool:
        """Reserve bytes; return False if the limit does not allow it."""
        with self._lock:
            if size > self._left:
                return False
            self._left -= size
            return True

    def give(self, size: int) -> None:
        """Release bytes."""
        with self._lock:
            self._left += size


@dataclass
class _Sender(Generic[T]):
    """Number of the last passed sample, and the live samples with sizes while the query runs."""

    last: int = -1
    asked: bool = False
    held: list[tuple[int, T, int]] | None = field(default_factory=list)


class Replay(Generic[T]):
    """Fetches the kept samples of each new sender once, ahead of its live samples; thread-safe.

    If a sender does not answer, its samples wait until the query ends or the budget is exhausted
    (``overdue``). ``take`` runs on one thread at a time. ``take`` and ``ask`` must return at once,
    without exceptions. After ``ask``, `replayed` and then `ended` must follow.
    """

    def __init__(
        self,
        take: Callable[[T], None],
        ask: Callable[[str], None],
        budget: Budget,
        overdue: Callable[[str], None],
    ) -> None:
        self._take = take
        self._ask = ask
        self._budget = budget
        self._overdue = overdue
        self._lock = threading.Lock()
        self._senders: dict[str, _Sender[T]] = {}

    def met(self, name: str) -> _Sender[T]:
        """Register a sender, and query a new one."""
        with self._lock:
            sender = self._senders.setdefault(name, _Sender())
            if sender.asked:
                return sender
            sender.asked = True
            if len(self._senders) > _KNOWN:
                self._release(self._senders.pop(next(iter(self._senders))))
        self._ask(name)
        return sender

    def hold(self) -> None:
        """Query each known sender again, for the samples between two sessions."""
        with self._lock:
            for sender in self._senders.values():
                sender.held = sender.held or []
                sender.asked = False

    def live(self, name: str, number: int, sample: T, size: int) -> None:
        """Take a live sample of `size` bytes with its sender's sequence number."""
        sender = self.met(name)
        with self._lock:
            if sender.held is not None:
                if self._budget.take(size):
                    sender.held.append((number, sample, size))
                    return
                self._release(sender)
                self._overdue(name)
            self._pass(sender, number, sample)

    def replayed(self, name: str, number: int, sample: T) -> None:
        """Take a kept sample, in the order of sequence numbers."""
        with self._lock:
            if (sender := self._senders.get(name)) is not None:
                self._pass(sender, number, sample)

    def ended(self, name: str) -> None:
        """Release the held samples after all kept samples have arrived or the query has failed."""
        with self._lock:
            if (sender := self._senders.get(name)) is not None:
                self._release(sender)

    def _release(self, sender: _Sender[T]) -> None:
        held = sender.held or []
        sender.held = None
        for number, sample, size in held:
            self._budget.give(size)
            self._pass(sender, number, sample)

    def _pass(self, sender: _Sender[T], number: int, sample: T) -> None:
        if number > sender.last:
            sender.last = number
            self._take(sample)
