"""Sessions of Zenoh: a router in this process, and clients of one. What Zenoh is told stands in ``zenoh_settings``."""

import json
import os
import socket
import threading
import time
from typing import Final

import zenoh

from schemas.topics import LANES
from services.kit.credentials import Credentials, others_reach, why_refused
from services.kit.wire import BusError
from services.kit.zenoh_settings import (
    CLIENT_THREADS,
    DEFAULT_ROUTER,
    MAX_SESSIONS,
    ROUTER_THREADS,
    check_credentials,
    host_and_port,
    named,
    router_settings,
    runtime,
    settings_of,
)

_RUNTIME: Final = "ZENOH_RUNTIME"  # Zenoh's own variable for how many threads it has for what, in a process.
_OPENING: Final = threading.Lock()


def _open(settings: dict[str, object], threads: int) -> zenoh.Session:
    """Open a session; the first one of a process decides, by the environment, how many threads take in what comes."""
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    with _OPENING:
        before = os.environ.get(_RUNTIME)
        os.environ[_RUNTIME] = before or runtime(threads)
        try:
            return zenoh.open(config)
        finally:
            if before is None:
                del os.environ[_RUNTIME]


def open_client(endpoint: str, credentials: Credentials, patience_s: float) -> zenoh.Session:
    """Connect to a router; BusError where none lets us in before the patience ends."""
    deadline = time.monotonic() + patience_s
    while True:
        try:
            return _open(settings_of("client", endpoint, credentials), CLIENT_THREADS)
        except zenoh.ZError:
            if time.monotonic() > deadline:
                raise BusError(_why_no_router(endpoint, credentials)) from None


def _why_no_router(endpoint: str, credentials: Credentials) -> str:
    """Tell a router that refuses us, for whatever reason of its own, from none."""
    try:
        socket.create_connection(host_and_port(endpoint), 1.0).close()
    except OSError:
        return f"no router at {endpoint}; start the stack with `smal up`"
    full = f"is full (it takes {MAX_SESSIONS} sessions, {len(LANES)} of each program)"
    if credentials is not None:
        refused = why_refused(credentials, *host_and_port(named(endpoint)))
        return refused or f"what listens at {endpoint} is no router that encrypts, does not answer, or {full}"
    return f"what listens at {endpoint} is no router, or takes nobody in without a certificate, or {full}"


class Router:
    """A Zenoh router in this process.

    With credentials only who has some as well gets in, and may do on the robot's bus what their role may; without them
    everybody may do everything, and it must be told to be ``insecure`` to listen where other machines reach it. Raises
    BusError when the endpoint is malformed, its port is taken, or strangers would get in.
    """

    def __init__(
        self,
        endpoint: str = DEFAULT_ROUTER,
        credentials: Credentials = None,
        robot: str = "",
        *,
        insecure: bool = False,
    ) -> None:
        host, _ = host_and_port(endpoint)
        check_credentials(endpoint, credentials)
        if credentials is None and not insecure and others_reach(host):
            raise BusError(
                f"{endpoint} can be reached from other machines, and whoever reaches it could drive the robot: "
                "give --secure DIR (`smal secure init` makes it), or --insecure"
            )
        try:
            self._session = _open(router_settings(endpoint, robot, credentials), ROUTER_THREADS)
        except zenoh.ZError as error:
            reason = "the port is in use" if "in use" in str(error) else str(error).partition(" at /")[0][:200]
            raise BusError(
                f"cannot listen on {endpoint}: {reason}; stop what uses it, or choose another port"
            ) from None

    def close(self) -> None:
        """Stop routing."""
        self._session.close()
