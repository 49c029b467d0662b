"""Health and metrics over HTTP: ``GET /healthz`` for whoever restarts services, ``GET /metrics`` for Prometheus."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, Final
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

from prometheus_client import CollectorRegistry, make_wsgi_app
from prometheus_client.exposition import ThreadingWSGIServer

if TYPE_CHECKING:
    from wsgiref.types import StartResponse, WSGIEnvironment

#: Connections at one time, each of which has a thread: those of a health check and of Prometheus, several times over.
MOST_CONNECTIONS: Final = 16


class HttpError(Exception):
    """The address cannot be listened on; the text says why in one line."""


class _Server(ThreadingWSGIServer):
    """Sends away who comes while too many are there, and says nothing of clients that went away."""

    #: Of five, as the library has it, who comes sixth at one moment waits a second or more for TCP to try again.
    request_queue_size = 128

    def __init__(self, *arguments: Any) -> None:  # noqa: ANN401 - as the library says
        self._room = threading.Semaphore(MOST_CONNECTIONS)
        super().__init__(*arguments)

    def verify_request(self, *_request: object) -> bool:
        """Tell whether there is room for another."""
        return self._room.acquire(blocking=False)

    def process_request_thread(self, *request: Any) -> None:  # noqa: ANN401
        """Answer one request, and make room."""
        try:
            super().process_request_thread(*request)
        finally:
            self._room.release()

    def handle_error(self, *_request: object) -> None:
        """Say nothing: what fails in an answer is told by who answers, and the rest is the client's."""


class _Handler(WSGIRequestHandler):
    timeout = 5.0  #: A client that sends nothing is sent away after so many seconds.

    def log_message(self, *_arguments: object) -> None:
        """Say nothing: a check every few seconds is no news."""


def serve_http(address: str, ailment: Callable[[], str | None], metrics: CollectorRegistry) -> WSGIServer:
    """Answer on threads of its own, so that a busy service answers as well, and a frozen one does not.

    Parameters
    ----------
    address
        ``HOST:PORT``; without a host, every interface.
    ailment
        Tells why the service is not healthy, None where it is.
    metrics
        What Prometheus is told.

    Returns
    -------
    WSGIServer
        Answers until its `shutdown`.

    Raises
    ------
    HttpError
        When the port is taken or the host is none of this machine's.
    """
    host, _, port = address.rpartition(":")
    tell = make_wsgi_app(metrics)

    def answer(asked: WSGIEnvironment, start: StartResponse) -> Iterable[bytes]:
        if asked["PATH_INFO"] != "/healthz":
            return tell(asked, start)  # type: ignore[no-any-return]
        problem = ailment()
        start(
            "200 OK" if problem is None else "503 Service Unavailable", [("Content-Type", "text/plain; charset=utf-8")]
        )
        return [f"{problem or 'ok'}\n".encode()]

    try:
        server = make_server(host, int(port), answer, _Server, _Handler)
    except (OSError, OverflowError) as error:
        reason = error.strerror if isinstance(error, OSError) else "no such port"
        raise HttpError(f"cannot answer HTTP on {address}: {reason}") from None
    threading.Thread(target=server.serve_forever, name="http", daemon=True).start()
    return server
