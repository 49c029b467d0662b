"""What goes wrong again and again, told once a second."""

import time


class Throttle:
    """Lets one line a second through: a sender that goes on and on must not fill the disk with the log."""

    _next_s = 0.0

    def due(self) -> bool:
        """Whether a line may be logged now."""
        now_s = time.monotonic()
        if now_s < self._next_s:
            return False
        self._next_s = now_s + 1.0
        return True
