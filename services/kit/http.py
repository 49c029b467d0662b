"""Health and metrics over HTTP: ``GET /healthz`` for whoever restarts services, ``GET /metrics`` for Prometheus."""

from __future__ import annotations

import socket
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Final, Self

from prometheus_client import CONTENT_TYPE_LATEST

_TEXT: Final = "text/plain; charset=utf-8"
#: A client that sends nothing is sent away after this time.
_PATIENCE_S: Final = 5.0
#: Connections at one time, each of which has a thread: those of a health check and of Prometheus, several times over.
MOST_CONNECTIONS: Final = 16


class HttpError(Exception):
    """The address cannot be listened on; the text says why in one line."""


class _Server(ThreadingHTTPServer):
    """Says nothing of clients that went away before their answer: a check that took too long is no news either.

    Where there are too many, the oldest gives way: clients that say nothing, or a little now and then, keep nobody out.
    """

    daemon_threads = True
    #: Of five, as the library has it, who comes sixth at one moment waits a second or more for TCP to try again.
    request_queue_size = 128

    def __init__(self, address: tuple[str, int], handler: type[BaseHTTPRequestHandler]) -> None:
        super().__init__(address, handler)
        self._open: dict[socket.socket, None] = {}
        self._lock = threading.Lock()

    def process_request(self, request: Any, client_address: Any) -> None:  # noqa: ANN401 - as the library says
        """Answer on a thread of its own."""
        with self._lock:
            if len(self._open) == MOST_CONNECTIONS:
                oldest = next(iter(self._open))
                del self._open[oldest]
                # Its thread finds the connection at its end, and closes it.
                with suppress(OSError):
                    oldest.shutdown(socket.SHUT_RDWR)
            self._open[request] = None
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:  # noqa: ANN401
        """Close a connection."""
        with self._lock:
            self._open.pop(request, None)
        super().shutdown_request(request)

    def handle_error(self, request: object, client_address: object) -> None:
        """Leave other errors to be printed."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)  # type: ignore[arg-type]


class HttpServer:
    """Answers on threads of its own, so that a busy service answers as well, and a frozen one does not.

    Parameters
    ----------
    address
        ``HOST:PORT``; without a host, every interface.
    ailment
        Tells why the service is not healthy, None where it is.
    metrics
        Gives the metrics in Prometheus' text format.

    Raises
    ------
    HttpError
        When the port is taken or the host is none of this machine's.
    """

    def __init__(self, address: str, ailment: Callable[[], str | None], metrics: Callable[[], bytes]) -> None:
        host, _, port = address.rpartition(":")

        class Handler(BaseHTTPRequestHandler):
            timeout = _PATIENCE_S

            def do_GET(self) -> None:
                """Answer one request."""
                if self.path == "/healthz":
                    problem = ailment()
                    status = HTTPStatus.OK if problem is None else HTTPStatus.SERVICE_UNAVAILABLE
                    self._answer(status, _TEXT, f"{problem or 'ok'}\n".encode())
                elif self.path == "/metrics":
                    self._answer(HTTPStatus.OK, CONTENT_TYPE_LATEST, metrics())
                else:
                    self._answer(HTTPStatus.NOT_FOUND, _TEXT, b"only /healthz and /metrics\n")

            def _answer(self, status: HTTPStatus, kind: str, body: bytes) -> None:
                self.send_response(status)
                self.send_header("Content-Type", kind)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *_arguments: object) -> None:
                """Say nothing: a check every few seconds is no news."""

        try:
            self._server = _Server((host, int(port)), Handler)
        except (OSError, OverflowError) as error:
            reason = error.strerror if isinstance(error, OSError) else "no such port"
            raise HttpError(f"cannot answer HTTP on {address}: {reason}") from None
        threading.Thread(target=self._server.serve_forever, name="http", daemon=True).start()

    @property
    def port(self) -> int:
        """The port, also where 0 was asked for."""
        return int(self._server.server_address[1])

    def close(self) -> None:
        """Stop listening."""
        self._server.shutdown()
        self._server.server_close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()
