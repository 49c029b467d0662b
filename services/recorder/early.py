"""Messages of episodes whose beginning has not arrived: order holds within a topic, not between topics."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Final

from schemas.base import Message
from schemas.codec import encode

#: How long they are kept, and how many of them.
EARLY_S: Final = 5.0
EARLY_QUEUE: Final = 4096
#: And how many bytes: frames as JPEG of half a megabyte, at 10 Hz, are 25 MB in that time.
EARLY_BYTES: Final = 64 << 20


class Early:
    """Holds the newest of them."""

    def __init__(self) -> None:
        #: When each arrived, itself, and its size.
        self._held: deque[tuple[float, Message, int]] = deque()
        self._bytes = 0

    def hold(self, message: Message, now_s: float) -> int:
        """Take a message; return how many had to give way."""
        self._held.append((now_s, message, len(encode(message))))
        self._bytes += self._held[-1][2]
        lost = 0
        while len(self._held) > EARLY_QUEUE or self._bytes > EARLY_BYTES:
            self._forget()
            lost += 1
        return lost

    def forget(self, now_s: float) -> None:
        """Forget those whose episode has not begun in time."""
        while self._held and now_s - self._held[0][0] > EARLY_S:
            self._forget()

    def of(self, episode: str) -> Iterator[Message]:
        """Give those of an episode that has begun."""
        held, self._held, self._bytes = self._held, deque(), 0
        for arrived_s, message, size in held:
            if message.episode == episode:
                yield message
            else:
                self._held.append((arrived_s, message, size))
                self._bytes += size

    def _forget(self) -> None:
        self._bytes -= self._held.popleft()[2]
