"""Cancellation of an episode while it begins: opening another world can take minutes."""

from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock

from services.kit.going_on import asking
from services.kit.node import ServiceError


class CancelledError(ServiceError):
    """The beginning was cancelled; the text names who did it."""


class Cancelling:
    """Cancels the beginning of an episode from any thread."""

    def __init__(self) -> None:
        self._lock = Lock()
        # Session that requested the episode that is beginning; None while idle.
        self._asker: str | None = None
        self._by: str | None = None

    def cancel(self, session: str, operator: str | None) -> None:
        """Cancel the beginning; ServiceError unless the requester or the operator calls."""
        with self._lock:
            if self._asker is None:
                raise ServiceError("no episode is beginning; nothing to cancel")
            if session not in (self._asker, operator):
                raise ServiceError(
                    "permission denied: only the requester of this episode or the operator "
                    "may cancel it"
                )
            self._by = "its requester" if session == self._asker else "the operator"

    @contextmanager
    def beginning(self, session: str) -> Iterator[None]:
        """Begin an episode for a session; a cancellation raises CancelledError at the next step."""
        with self._lock:
            self._asker = session
            self._by = None
        try:
            with asking(self._go_on):
                yield
        finally:
            with self._lock:
                self._asker = None
        self._go_on()

    def _go_on(self) -> None:
        if self._by is not None:
            raise CancelledError(f"cancelled by {self._by}")
