"""A session with a router, and what is declared in it: who has lost a router and finds it again comes under a new name.

A router that had no time for a while may add the connection of who comes back to what it knows of who was there before
(Zenoh 1.10.2, its issue 2806): the numbers of keys then mean other keys to it, and messages come under the key of
another, or never. It goes by the session's id; so a new session takes over, in which everything is declared anew.
"""

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final, Generic, Protocol, TypeVar

import zenoh

from schemas.topics import KEPT_S
from services.kit.wire import BusError

_PATIENCE_S: Final = 10.0  # How long one try to open a new session waits; there is always another.


class Entity(Protocol):
    """What Zenoh returns for what is declared."""

    def undeclare(self) -> Any:  # noqa: ANN401 - Zenoh's classes return nothing
        """Take it back."""


E = TypeVar("E", bound=Entity)


class Declared(Generic[E]):
    """What was declared: ``entity`` is that of the session of now."""

    def __init__(self, make: Callable[[zenoh.Session], E], entity: E, *, sends: bool) -> None:
        self.make = make
        self.entity = entity
        self.sends = sends


class Connection:
    """A session, and those that take over from it; ``open_session`` is given how long it may wait for a router.

    Any thread may call. What ``sends`` is not taken back with the session before, which stays for as long as samples
    are kept: somebody may be sending just now, and whoever lacks some can ask there. Raises what the first opening
    raises.
    """

    def __init__(self, open_session: Callable[[float], zenoh.Session], patience_s: float) -> None:
        self._open = open_session
        self._lock = threading.RLock()
        self._declared: list[Declared[Any]] = []
        self._before: tuple[()] | tuple[zenoh.Session, list[Entity]] = ()
        self._closed = False
        self.session = self._opened(patience_s)

    def declare(self, make: Callable[[zenoh.Session], E], *, sends: bool = False) -> Declared[E]:
        """Declare what ``make`` makes, in this session and in those that follow."""
        with self._lock:
            declared = Declared(make, make(self.session), sends=sends)
            self._declared.append(declared)
            return declared

    def let_go(self, declared: Declared[Any]) -> None:
        """Take back what was declared, once."""
        with self._lock:
            if declared in self._declared:
                self._declared.remove(declared)
                declared.entity.undeclare()

    def close(self) -> None:
        """Take back everything and leave the router."""
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
            elif router in lost:  # and at no other one meanwhile
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
            for one in self._declared:
                if not one.sends:
                    one.entity.undeclare()
            self._end_before()
            self._before = old, [one.entity for one in self._declared if one.sends]
            self.session = new
            for one in self._declared:
                one.entity = one.make(new)
        time.sleep(KEPT_S)
        with self._lock:
            if old in self._before:
                self._end_before()

    def _end_before(self) -> None:
        if self._before:
            self._before[0].close()
        self._before = ()
