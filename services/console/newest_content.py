"""The newest of everything, for those who watch.

Nothing waits for a watcher: whoever is slow finds something newer when they look again, and never what was in between.
So one that stands still costs one event, whatever it is sent.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from threading import Lock
from typing import Final

from services.robot.clock import now_s

#: Most watchers at a time.
MOST_WATCHERS: Final = 64


class Board:
    """Holds the newest content of each channel, as JSON, and the newest picture.

    ``put`` and ``show`` may be called on any thread.

    Parameters
    ----------
    clock
        Seconds; whatever tells an age goes by it.
    """

    def __init__(self, clock: Callable[[], float] = now_s) -> None:
        self.clock = clock
        self._lock = Lock()
        self._version = 0
        self._channels: dict[str, tuple[int, str]] = {}
        self._picture: tuple[int, bytes] = (0, b"")
        self._watchers: list[Watcher] = []

    def put(self, channel: str, content: object) -> None:
        """Replace what a channel holds."""
        text = json.dumps(content, separators=(",", ":"), allow_nan=False)
        with self._lock:
            if self._channels.get(channel, (0, ""))[1] == text:
                return
            self._version += 1
            self._channels[channel] = (self._version, text)
            self._wake()

    def show(self, picture: bytes) -> None:
        """Replace the picture."""
        with self._lock:
            self._version += 1
            self._picture = (self._version, picture)
            self._wake()

    def _wake(self) -> None:
        for watcher in self._watchers:
            watcher.wake()

    def since(self, version: int) -> tuple[int, str, bytes]:
        """Return what is newer than a version: the newest version, channels as one JSON object, the picture or none.

        The object's ``now`` is when it was made, by the clock; ``picture`` says whether there is one.
        """
        with self._lock:
            new = [f'"{name}":{text}' for name, (at, text) in self._channels.items() if at > version]
            at, picture = self._picture
            due = picture if at > version else b""
            head = f'"now":{self.clock():.3f},"picture":{"true" if due else "false"}'
            return self._version, "{" + ",".join([head, *new]) + "}", due

    @contextmanager
    def watched(self) -> Iterator[Watcher]:
        """Give a watcher in a running event loop.

        Raises
        ------
        FullError
            When there are too many.
        """
        watcher = Watcher(self)
        with self._lock:
            if len(self._watchers) >= MOST_WATCHERS:
                raise FullError
            self._watchers.append(watcher)
        try:
            yield watcher
        finally:
            with self._lock:
                self._watchers.remove(watcher)

    @property
    def watchers(self) -> int:
        """How many watch."""
        return len(self._watchers)


class FullError(Exception):
    """Too many watch."""


class Watcher:
    """One who watches, in an event loop of its own thread."""

    def __init__(self, board: Board) -> None:
        self._board = board
        self._loop = asyncio.get_running_loop()
        self._changed = asyncio.Event()
        self._changed.set()
        self._seen = 0

    def wake(self) -> None:
        """Tell that something has changed; from any thread."""
        with suppress(RuntimeError):  # of a loop that has just ended
            self._loop.call_soon_threadsafe(self._changed.set)

    async def newest(self) -> tuple[str, bytes]:
        """Wait for a change; return what is new to this watcher, see ``Board.since``."""
        await self._changed.wait()
        self._changed.clear()
        self._seen, text, picture = self._board.since(self._seen)
        return text, picture
