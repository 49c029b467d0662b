"""HTTP server of the page: one event loop on its own thread, with fair turns for connections."""

import asyncio
import logging
import ssl
import threading
from typing import Final

import uvicorn
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from services.console.config import ConsoleSettings, listen
from services.console.guard import AccessGuard
from services.console.newest_content import Board
from services.console.service import ConsoleService
from services.console.web import Web
from services.kit.node import ServiceError
from services.kit.throttle import Throttle

# Maximum message of a browser, bytes: the names of a thousand recordings.
_MOST_BYTES: Final = 1 << 20
_AT_ONCE: Final = 1024  # Bytes read in a turn: 20 answers, 1 ms.
_FAREWELL_S: Final = 1  # Timeout of closing sockets at shutdown.
# Dummy password, so that encrypted keys fail instead of prompting in the terminal.
_NO_WORD: Final = "-"
_complaints = Throttle()


class _Socket(WebSocketsSansIOProtocol, asyncio.BufferedProtocol):
    """Limits each read, so that a flooding browser leaves turns for all others."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._read = bytearray(_AT_ONCE)
        super().connection_made(transport)

    def get_buffer(self, sizehint: int) -> bytearray:
        return self._read

    def buffer_updated(self, nbytes: int) -> None:
        self.data_received(bytes(self._read[:nbytes]))

    def handle_ping(self) -> None:
        if self.writable.is_set():
            super().handle_ping()
        else:
            # Drop the pong of a browser that does not read, which would fill the memory.
            self.conn.data_to_send()


class WebServer:
    """Serves the page; raises ServiceError for a failed address or certificate."""

    def __init__(self, service: ConsoleService, board: Board, settings: ConsoleSettings) -> None:
        self._socket, self.address, token = listen(settings)
        # Throttled, so that invalid requests cannot fill the disk with logs.
        logging.getLogger("uvicorn.error").addFilter(lambda _: _complaints.due())
        config = uvicorn.Config(
            AccessGuard(Web(service, board).application(), token),
            ws=_Socket,
            ws_max_size=_MOST_BYTES,
            # Keeps silent watchers connected.
            ws_ping_interval=20.0,
            ws_per_message_deflate=False,
            ssl_certfile=settings.console_cert,
            ssl_keyfile=settings.console_key,
            ssl_keyfile_password=_NO_WORD,
            lifespan="off",
            log_config=None,
            log_level="warning",
            access_log=False,
            server_header=False,
            proxy_headers=False,
            timeout_graceful_shutdown=_FAREWELL_S,
        )
        try:
            config.load()
        except (ssl.SSLError, OSError) as error:
            self._socket.close()
            raise ServiceError(
                f"{settings.console_cert}: invalid certificate or key ({error})"
            ) from None
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(
            target=self._server.run, args=([self._socket],), name="web", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Stop listening."""
        self._server.should_exit = True
        self._thread.join(2 * _FAREWELL_S)
        if not self._thread.is_alive():  # Closing the socket earlier would fail the loop.
            self._socket.close()
