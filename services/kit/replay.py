"""What a sender kept from before somebody listened, and then what it sends, in its order and each once.

Zenoh's own subscriber with history loses all that it has fetched where a live sample comes after the end of its first
query and before the end of its second, which is for senders that appear later (1.10.2; under load one start in two of
a subscriber to a dozen topics). So we fetch ourselves.
"""

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, Generic, TypeVar

T = TypeVar("T")

#: Senders that are known again; a subscriber hears of one at a time, and of another whenever that is restarted.
_KNOWN: Final = 64


class Budget:
    """Bytes that may be held at one time by all who share them; any thread may call."""

    def __init__(self, most: int) -> None:
        self._left = most
        self._lock = threading.Lock()

    def take(self, size: int) -> bool:
        """Whether there is room for so much more, which is then taken."""
        with self._lock:
            if size > self._left:
                return False
            self._left -= size
            return True

    def give(self, size: int) -> None:
        """Make room again."""
        with self._lock:
            self._left += size


@dataclass
class _Sender(Generic[T]):
    """Number of the last sample passed on, and, until what was kept has come, the live samples and their sizes."""

    last: int = -1
    asked: bool = False
    held: list[tuple[int, T, int]] | None = field(default_factory=list)


class Replay(Generic[T]):
    """Asks each sender that it hears of, once, for what it kept; what is live waits until that has come.

    Of a sender that does not answer, samples wait until its query ends or there is no room (``overdue``). Any thread
    may call. ``take`` is called by one thread at a time; both must return at once, and not raise. After ``ask``,
    `replayed` and then `ended` must follow.
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
        """Note that a sender is there."""
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
        """Ask each sender once more when it is heard of: what comes from now on does not follow what came before."""
        with self._lock:
            for sender in self._senders.values():
                sender.held = sender.held or []
                sender.asked = False

    def live(self, name: str, number: int, sample: T, size: int) -> None:
        """Take a sample of `size` bytes that was just sent, the `number`-th of its sender; numbers grow."""
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
        """Take a sample that was kept, in the order of numbers."""
        with self._lock:
            if (sender := self._senders.get(name)) is not None:
                self._pass(sender, number, sample)

    def ended(self, name: str) -> None:
        """Note that all that was kept has come, or that the sender does not answer."""
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
