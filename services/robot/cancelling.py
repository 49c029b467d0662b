"""The cancelling of an episode that is being begun: another world may take minutes to open."""

from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock

from services.kit.going_on import asking
from services.kit.node import ServiceError


class CancelledError(ServiceError):
    """The beginning was cancelled; the text says by whom."""


class Cancelling:
    """Ends what one thread begins because another one says so; ``cancel`` may be called on any thread."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._asker: str | None = (
            None  # Who has asked for what is being begun; None while nothing is.
        )
        self._by: str | None = None

    def cancel(self, session: str, operator: str | None) -> None:
        """End what is being begun; ServiceError unless who asked for it, or the operator (a session), says so."""
        with self._lock:
            if self._asker is None:
                raise ServiceError("there is nothing to cancel: no episode is being begun")
            if session not in (self._asker, operator):
                raise ServiceError(
                    "only who asked for this episode, or the operator, may cancel it"
                )
            self._by = "who asked for it" if session == self._asker else "the operator"

    @contextmanager
    def beginning(self, session: str) -> Iterator[None]:
        """Begin what a session has asked for. Raises CancelledError, at the next step or at the end, once cancelled."""
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
