"""Latest content for watchers; slow watchers skip content instead of delaying it."""

import asyncio
import json
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager, suppress
from threading import Lock
from typing import Final

from services.robot.clock import now_s

MOST_WATCHERS: Final = 64  # Maximum number of watchers.
#: Waits for a change; returns the changed channels as a JSON object, and the changed picture or
#: b"".
Newest = Callable[[], Awaitable[tuple[str, bytes]]]


class FullError(Exception):
    """Too many watchers."""


class Board:
    """Latest content of each channel, as JSON, and the latest picture; thread-safe.

    ``clock`` gives the time in seconds that ages refer to.
    """

    def __init__(self, clock: Callable[[], float] = now_s) -> None:
        self.clock = clock
        self._lock = Lock()
        self._version = 0
        self._channels: dict[str, tuple[int, str]] = {}
        self._picture: tuple[int, bytes] = (0, b"")
        self._wakes: list[Callable[[], None]] = []

    def put(self, channel: str, content: object) -> None:
        """Replace the content of a channel."""
        text = json.dumps(content, separators=(",", ":"), allow_nan=False)
        with self._lock:
            if self._channels.get(channel, (0, ""))[1] != text:
                self._channels[channel] = (self._next(), text)

    def show(self, picture: bytes) -> None:
        """Replace the picture."""
        with self._lock:
            self._picture = (self._next(), picture)

    def _next(self) -> int:
        self._version += 1
        for wake in self._wakes:
            wake()
        return self._version

    def _since(self, version: int) -> tuple[int, str, bytes]:
        """Return the latest version, newer channels as JSON with ``now``, and the picture."""
        with self._lock:
            new = [
                f'"{name}":{text}' for name, (at, text) in self._channels.items() if at > version
            ]
            at, picture = self._picture
            due = picture if at > version else b""
            head = f'"now":{self.clock():.3f},"picture":{"true" if due else "false"}'
            return self._version, "{" + ",".join([head, *new]) + "}", due

    @contextmanager
    def watched(self) -> Iterator[Newest]:
        """Register a watcher of the running event loop; raises FullError at the maximum."""
        loop = asyncio.get_running_loop()
        changed = asyncio.Event()
        seen = 0
        changed.set()

        def wake() -> None:
            with suppress(RuntimeError):  # The loop has just ended.
                loop.call_soon_threadsafe(changed.set)

        async def newest() -> tuple[str, bytes]:
            nonlocal seen
            await changed.wait()
            changed.clear()
            seen, text, picture = self._since(seen)
            return text, picture

        with self._lock:
            if len(self._wakes) >= MOST_WATCHERS:
                raise FullError
            self._wakes.append(wake)
        try:
            yield newest
        finally:
            with self._lock:
                self._wakes.remove(wake)

    @property
    def watchers(self) -> int:
        """Number of watchers."""
        return len(self._wakes)
