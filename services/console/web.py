"""The page's server: files, pictures, and two sockets for each browser, one to watch and one to drive."""

from __future__ import annotations

import asyncio
import logging
import ssl
import threading
from collections.abc import AsyncIterator, Callable, Coroutine
from concurrent.futures import Future
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, Protocol

import uvicorn
from pydantic import ValidationError
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from schemas.base import Atom
from schemas.codec import describe
from services.console.address import listen
from services.console.browser_messages import LATE, OF_DRIVER, OF_WATCHERS, Ask, Hold, Leave, Stop
from services.console.config import ConsoleSettings
from services.console.folder import Folder
from services.console.guard import MAP, Guard
from services.console.learned import Learned
from services.console.library import Library
from services.console.maps import Maps
from services.console.newest_content import Board, FullError
from services.console.who_drives import BEAT_S, LEASE_S, Seat
from services.kit.node import ServiceError
from services.kit.throttle import Throttle

PAGE: Final = Path(__file__).parent / "page"
#: A watcher is sent something at most so often.
_APART_S: Final = 0.05
#: Most bytes that a browser says at once: the names of a thousand recordings.
_MOST_BYTES: Final = 1 << 20
#: Bytes of a socket that are read before it is the others' turn: 20 answers to beats, which take 1 ms.
_AT_ONCE: Final = 1024
#: Codes by which a socket is closed: too many watch; somebody else drives; what was said makes no sense.
FULL, TAKEN, NONSENSE = 4001, 4002, 4003
#: How long open sockets may take to close at the end.
_FAREWELL_S: Final = 1
#: Digits of the number of a picture, at most.
_DIGITS: Final = 9
#: Opens no key that is encrypted, for which the terminal would be asked.
_NO_WORD: Final = "-"
_complaints = Throttle()


class Person(Protocol):
    """What a browser's person can do, and look at; see ``ConsoleService``.

    What they do is done when its future ends. A browser is heard further then: so nothing waits behind more than one
    thing that each has said, be it an emergency stop behind a flood.
    """

    @property
    def library(self) -> Library:
        """What was recorded and learned."""

    @property
    def learned(self) -> Learned | None:
        """The model that the robot goes by."""

    def hold(self, atom: Atom | None, sent_s: float) -> Future[None]:
        """Be there, and hold a key, as of a time of the board's clock."""

    def let_go(self) -> Future[None]:
        """Be gone."""

    def leave(self) -> Future[None]:
        """Stand up."""

    def stop(self) -> Future[None]:
        """Stop for an emergency."""

    def ask(self, ask: Ask, until_s: float) -> Future[None]:
        """Ask for something, to be done until a time of the board's clock."""

    def make_world(self, name: str, osm_map: Path, folder: Folder) -> Future[None]:
        """Have a world made of a map, and then its folder closed."""


class Web:
    """Answers browsers, in one event loop.

    Parameters
    ----------
    person
        What they can do.
    board
        What they see.
    """

    def __init__(self, person: Person, board: Board) -> None:
        self._person = person
        self._board = board
        self._seat = Seat(board.clock)
        self._maps = Maps(person.make_world, self._seat)

    def application(self) -> Starlette:
        """Return what answers; without its guard."""
        return Starlette(
            routes=[
                Route("/thumbnail", self._thumbnail),
                Route(MAP, self._maps.take, methods=["POST"]),
                Route("/taught/{model}/{keyframe}", self._taught),
                WebSocketRoute("/watch", self._watch),
                WebSocketRoute("/drive", self._drive),
                Mount("/", StaticFiles(directory=PAGE, html=True)),
            ]
        )

    # -- pictures -------------------------------------------------------------------------------------------------

    async def _thumbnail(self, request: Request) -> Response:
        """Answer with a small picture of a recording; its name is looked for in the list, and opens nothing."""
        recording = self._person.library.recording(request.query_params.get("of", ""))
        number = _number(request.query_params.get("k", ""))
        if recording is None or number is None or number >= len(recording.thumbnails):
            return PlainTextResponse("no such picture\n", 404)
        return _picture(recording.thumbnails[number])

    async def _taught(self, request: Request) -> Response:
        """Answer with the taught image of a keyframe."""
        learned = self._person.learned
        known = learned is not None and learned.identity == request.path_params["model"]
        keyframe = _number(request.path_params["keyframe"])
        picture = learned.image(keyframe) if learned is not None and known and keyframe is not None else None
        return PlainTextResponse("no such picture\n", 404) if picture is None else _picture(picture)

    # -- watching -------------------------------------------------------------------------------------------------

    async def _watch(self, browser: WebSocket) -> None:
        """Send the newest, and more when that was seen: at most one message is on its way, however slow that is."""
        await browser.accept()
        seen = asyncio.Event()
        seen.set()

        async def listen() -> None:
            async for said in _said(browser):
                if isinstance(OF_WATCHERS.validate_json(said), Stop):
                    await asyncio.wrap_future(self._person.stop())
                elif seen.is_set():
                    raise _NonsenseError("there is nothing more to be seen")
                else:
                    seen.set()

        try:
            with self._board.watched() as watcher:

                async def tell() -> None:
                    while True:
                        text, picture = await watcher.newest()
                        seen.clear()
                        await browser.send_text(text)
                        if picture:
                            await browser.send_bytes(picture)
                        await asyncio.sleep(_APART_S)
                        await seen.wait()

                await _until_one_ends(browser, listen(), tell())
        except FullError:
            await browser.close(FULL, "too many watch")

    # -- driving --------------------------------------------------------------------------------------------------

    async def _drive(self, browser: WebSocket) -> None:
        """Give a browser the seat for as long as it answers beats."""
        await browser.accept()
        if not self._seat.take(browser):
            await browser.close(TAKEN, "somebody else drives")
            return
        self._board.put("taken", content=True)
        word = self._seat.word  # later it may be somebody else's

        async def beat() -> None:
            await browser.send_json({"word": word})
            while self._seat.holds(browser):
                await browser.send_json({"beat": self._seat.beat()})
                await asyncio.sleep(BEAT_S)

        try:
            await _until_one_ends(browser, self._listen(browser), beat())
        finally:
            self._stand_up(browser, self._person.let_go)

    async def _listen(self, browser: WebSocket) -> None:
        """Do what whoever drives says, until they leave or somebody else has the seat.

        Nonsense moves nothing; they are told, and go on: a name that may not be is no reason to lose the robot.
        """
        async for text in _said(browser):
            if not self._seat.holds(browser):
                return
            try:
                said = OF_DRIVER.validate_json(text)
            except ValidationError as error:
                await browser.send_json({"refused": _plainly(error)})
                continue
            if isinstance(said, Hold):
                sent_s = self._seat.answered(said.beat)
                if sent_s is not None:
                    await asyncio.wrap_future(self._person.hold(said.atom, sent_s))
            elif isinstance(said, Leave):
                self._stand_up(browser, self._person.leave)
                return
            elif isinstance(said, Stop):
                await asyncio.wrap_future(self._person.stop())
            elif (sent_s := self._seat.answered(said.beat)) is not None:
                await asyncio.wrap_future(self._person.ask(said, sent_s + LEASE_S))
            else:
                await browser.send_json({"refused": LATE})

    def _stand_up(self, browser: WebSocket, how: Callable[[], Future[None]]) -> None:
        if self._seat.holds(browser):
            self._seat.leave(browser)
            self._board.put("taken", content=False)
            how()


class _NonsenseError(Exception):
    """A browser says what is no answer to what it was sent."""


def _plainly(error: ValidationError) -> str:
    """Say what is wrong with what was asked for; what kind of message it came in means nothing to who asked."""
    where = error.errors(include_url=False)[0]["loc"]
    return describe(error).removeprefix(f"{where[0]}." if where else "")


async def _said(browser: WebSocket) -> AsyncIterator[str]:
    """Give what a browser says until it is gone; bytes say nothing."""
    while (message := await browser.receive())["type"] != "websocket.disconnect":
        yield message.get("text") or ""


async def _until_one_ends(browser: WebSocket, *tasks: Coroutine[Any, Any, None]) -> None:
    """Run what talks to a browser, until it is gone, nothing more is to be said, or it says what it may not."""
    running = [asyncio.ensure_future(task) for task in tasks]
    try:
        await asyncio.wait(running, return_when=asyncio.FIRST_COMPLETED)
        for task in running:
            if task.done():
                task.result()
    except (ValidationError, _NonsenseError) as error:
        why = describe(error) if isinstance(error, ValidationError) else str(error)
        with suppress(RuntimeError, WebSocketDisconnect):
            await browser.close(NONSENSE, why[:100])
    except (WebSocketDisconnect, RuntimeError):
        return  # it went away while it was being sent something
    finally:
        for task in running:
            task.cancel()
        await asyncio.gather(*running, return_exceptions=True)
    if browser.application_state is WebSocketState.CONNECTED:
        with suppress(RuntimeError, WebSocketDisconnect):
            await browser.close()


def _number(digits: str) -> int | None:
    return int(digits) if digits.isdecimal() and len(digits) <= _DIGITS else None


def _seldom(_: logging.LogRecord) -> bool:
    return _complaints.due()


def _picture(jpeg: bytes) -> Response:
    # What a name or a number stands for does not change while the page is open.
    return Response(jpeg, media_type="image/jpeg", headers={"Cache-Control": "private, max-age=3600"})


class _Socket(WebSocketsSansIOProtocol, asyncio.BufferedProtocol):
    """Takes turns with all others, however much its browser says: what is read is read to its end before they go on.

    It answers no pings of who does not take the answers: they would fill the memory.
    """

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
            self.conn.data_to_send()  # the answer


class WebServer:
    """Serves the page on a thread of its own.

    Parameters
    ----------
    person
        What browsers can do.
    board
        What they see.
    settings
        Where to listen, and who gets in.

    Raises
    ------
    ServiceError
        When that may not be listened on, or cannot be, or the certificate is of no use.
    """

    def __init__(self, person: Person, board: Board, settings: ConsoleSettings) -> None:
        place = listen(settings)
        self._socket, token = place.socket, place.token
        # Who sends rubbish must not fill the disk with the log.
        logging.getLogger("uvicorn.error").addFilter(_seldom)
        config = uvicorn.Config(
            Guard(Web(person, board).application(), token),
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
            place.socket.close()
            raise ServiceError(f"{settings.console_cert} and its key are of no use: {error}") from None
        self._server = uvicorn.Server(config)
        self.address = place.address
        self._thread = threading.Thread(
            target=self._server.run, kwargs={"sockets": [self._socket]}, name="web", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Stop listening."""
        self._server.should_exit = True
        self._thread.join(2 * _FAREWELL_S)
        self._socket.close()
