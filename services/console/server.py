"""The page's server: one loop, on a thread of its own, in which nobody keeps the others from their turn."""

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

_MOST_BYTES: Final = (
    1 << 20
)  # Most bytes that a browser says at once: the names of a thousand recordings.
_AT_ONCE: Final = 1024  # Bytes that are read before it is others' turn: 20 answers, 1 ms.
_FAREWELL_S: Final = 1  # How long open sockets may take to close at the end.
_NO_WORD: Final = "-"  # Opens no key that is encrypted, for which the terminal would be asked.
_complaints = Throttle()


class _Socket(WebSocketsSansIOProtocol, asyncio.BufferedProtocol):
    """Takes turns with all others, however much its browser says: what is read is read to its end before they go on."""

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
            self.conn.data_to_send()  # the answer: of who takes none, they would fill the memory


class WebServer:
    """Serves the page; ServiceError when it may not listen there, or cannot, or the certificate is of no use."""

    def __init__(self, service: ConsoleService, board: Board, settings: ConsoleSettings) -> None:
        self._socket, self.address, token = listen(settings)
        # Who sends rubbish must not fill the disk with the log.
        logging.getLogger("uvicorn.error").addFilter(lambda _: _complaints.due())
        config = uvicorn.Config(
            AccessGuard(Web(service, board).application(), token),
            ws=_Socket,
            ws_max_size=_MOST_BYTES,
            # A browser that says nothing for a while may still look.
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
                f"{settings.console_cert} and its key are of no use: {error}"
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
        if not self._thread.is_alive():  # its loop would fail under a socket that is closed
            self._socket.close()
