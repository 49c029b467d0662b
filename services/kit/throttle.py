"""Throttling of repeated log messages."""

import time


class Throttle:
    """Limit of one log line a second, so that a persistent sender cannot fill the disk."""

    _next_s = 0.0

    def due(self) -> bool:
        """Return whether a line may be logged now."""
        now_s = time.monotonic()
        if now_s < self._next_s:
            return False
        self._next_s = now_s + 1.0
        return True
