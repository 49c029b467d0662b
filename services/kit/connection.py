"""Sessions with a router that renew themselves after an outage.

A busy router can confuse a reconnected session with its previous connection (Zenoh 1.10.2, its
issue 2806). Its numbers of keys then mean other keys, and messages arrive under wrong keys or not
at all. The router identifies sessions by their id, so a new session with a new id takes over and
repeats all declarations.
"""

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final, Generic, Protocol, TypeVar

import zenoh

from schemas.topics import KEPT_S
from services.kit.wire import BusError

# Timeout of one attempt to open a new session; attempts repeat.
_PATIENCE_S: Final = 10.0


class Entity(Protocol):
    """Declared entity of Zenoh."""

    def undeclare(self) -> Any:  # noqa: ANN401 - Zenoh's classes return nothing
        """Withdraw the declaration."""


E = TypeVar("E", bound=Entity)


class Declared(Generic[E]):
    """Declaration whose ``entity`` belongs to the current session."""

    def __init__(self, make: Callable[[zenoh.Session], E], entity: E, *, sends: bool) -> None:
        self.make = make
        self.entity = entity
        self.sends = sends


class Connection:
    """The current session and its declarations, which successors take over; thread-safe.

    Publishers (``sends``) outlive their session for as long as samples are kept: another thread can
    be sending, and subscribers can still fetch from them. The constructor raises the error of
    ``open_session``, whose argument is its timeout in seconds.
    """

    def __init__(self, open_session: Callable[[float], zenoh.Session], patience_s: float) -> None:
        self._open = open_session
        self._lock = threading.RLock()
        self._declared: list[Declared[Any]] = []
        self._before: tuple[()] | tuple[zenoh.Session, list[Entity]] = ()
        self._closed = False
        self.session = self._opened(patience_s)

    def declare(self, make: Callable[[zenoh.Session], E], *, sends: bool = False) -> Declared[E]:
        """Declare an entity by ``make``, in this session and its successors."""
        with self._lock:
            declared = Declared(make, make(self.session), sends=sends)
            self._declared.append(declared)
            return declared

    def let_go(self, declared: Declared[Any]) -> None:
        """Withdraw a declaration; further calls have no effect."""
        with self._lock:
            if declared in self._declared:
                self._declared.remove(declared)
                declared.entity.undeclare()

    def close(self) -> None:
        """Withdraw all declarations and disconnect."""
        with self._lock:
            self._closed = True
            while self._declared:
                self._declared.pop().entity.undeclare()
            self._end_before()
            self.session.close()

    def _opened(self, patience_s: float) -> zenoh.Session:
        session = self._open(patience_s)
        lost = list[str]()

        def on_event(event: zenoh.TransportEvent) -> None:
            router = str(event.transport.zid)
            if event.kind == zenoh.SampleKind.DELETE:
                lost[:] = [router]
            elif router in lost:  # The same router is back, with no other in between.
                threading.Thread(
                    target=self._renew, args=(session,), name="a new session", daemon=True
                ).start()

        callback = zenoh.handlers.Callback(on_event, indirect=False)
        self._listener = session.info.declare_transport_events_listener(callback)
        return session

    def _renew(self, old: zenoh.Session) -> None:
        new: zenoh.Session | None = None
        while new is None and not self._closed:
            with suppress(BusError):
                new = self._opened(_PATIENCE_S)
        with self._lock:
            if new is None or self._closed or old is not self.session:
                if new is not None:
                    new.close()
                return
            for declared in self._declared:
                if not declared.sends:
                    declared.entity.undeclare()
            self._end_before()
            self._before = old, [item.entity for item in self._declared if item.sends]
            self.session = new
            for declared in self._declared:
                declared.entity = declared.make(new)
        time.sleep(KEPT_S)
        with self._lock:
            if old in self._before:
                self._end_before()

    def _end_before(self) -> None:
        if self._before:
            self._before[0].close()
        self._before = ()
