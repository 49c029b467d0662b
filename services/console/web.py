"""HTTP and WebSocket endpoints of the page: files, pictures, uploads, watching, driving."""

import asyncio
import base64
import tempfile
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, Final

from pydantic import TypeAdapter, ValidationError
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from schemas.codec import describe
from schemas.rpc import WorldName
from services.console.browser_messages import LATE, OF_DRIVER, OF_WATCHERS, Hold, Leave, StopRequest
from services.console.guard import MAP
from services.console.newest_content import Board, FullError
from services.console.report import POLICY, report_page
from services.console.service import ConsoleService
from services.console.who_drives import BEAT_S, LEASE_S, Seat
from services.kit.world_files import HEAD_BYTES, largest_upload
from services.recordings.stream import RecordingError

PAGE: Final = Path(__file__).parent / "page"
_APART_S: Final = 0.05  # Minimum interval of updates to a watcher.
# WebSocket close codes.
FULL = 4001
TAKEN = 4002
NONSENSE = 4003
_DIGITS: Final = 9  # Maximum digits of a picture's number.
# Timeout of the upload of a map or scan (2 Mbit/s or more).
_UPLOAD_S: Final = 600
_NO_RECORDING: Final = "recording not found; it was deleted or renamed\n"
_NOT_THEIRS: Final = "permission denied: take control first\n"
_WORLD_NAME: Final[TypeAdapter[str]] = TypeAdapter(WorldName)


class Web:
    """Endpoints for browsers, in one event loop.

    A connection is read again only after its last request has ended. So an emergency stop waits for
    at most one request of each browser, even in a flood.
    """

    def __init__(self, service: ConsoleService, board: Board) -> None:
        self._service = service
        self._board = board
        self._seat = Seat(board.clock)
        self._uploads = 0  # Number of started uploads.

    def application(self) -> Starlette:
        """Return the application without access control."""
        return Starlette(
            routes=[
                Route("/thumbnail", self._thumbnail),
                Route("/report", self._report),
                Route("/moments", self._moments),
                Route(MAP, self._take_upload, methods=["POST"]),
                Route("/taught/{model}/{keyframe}", self._taught),
                WebSocketRoute("/watch", self._watch),
                WebSocketRoute("/drive", self._drive),
                Mount("/", StaticFiles(directory=PAGE, html=True)),
            ]
        )

    def _do(self, what: Callable[..., None], *arguments: object) -> asyncio.Future[None]:
        return asyncio.wrap_future(self._service.do(what, *arguments))

    async def _thumbnail(self, request: Request) -> Response:
        """Return a thumbnail of a listed recording; the name does not open files."""
        recording = self._service.library.recording(request.query_params.get("of", ""))
        number = _number(request.query_params.get("k", ""))
        if recording is None or number is None or number >= len(recording.thumbnails):
            return _picture(None)
        return _picture(recording.thumbnails[number])

    async def _report(self, request: Request) -> Response:
        """Return the report of a listed recording, a page that can be saved and sent as one file."""
        recording = self._service.library.recording(request.query_params.get("of", ""))
        if recording is None:
            return PlainTextResponse(_NO_RECORDING, 404)
        return HTMLResponse(report_page(recording), headers={"Content-Security-Policy": POLICY})

    async def _moments(self, request: Request) -> Response:
        """Return pictures and poses along a listed recording, for the card of a finished run."""
        library = self._service.library
        recording = library.recording(request.query_params.get("of", ""))
        if recording is None:
            return PlainTextResponse(_NO_RECORDING, 404)
        try:
            found = await asyncio.to_thread(library.moments, recording)
        except (RecordingError, OSError) as error:
            return PlainTextResponse(f"{recording.name}: {error}\n", 404)
        moments = [
            {"s": one.seconds, "here": one.pose, "picture": base64.b64encode(one.picture).decode()}
            for one in found.moments
        ]
        return JSONResponse({"metres": recording.metres, "true": found.true, "moments": moments})

    async def _taught(self, request: Request) -> Response:
        learned = self._service.live.learned
        keyframe = _number(request.path_params["keyframe"])
        if learned is None or keyframe is None or learned.identity != request.path_params["model"]:
            return _picture(None)
        return _picture(learned.image(keyframe))

    async def _take_upload(self, request: Request) -> Response:
        """Receive a map or scan from the driver and start its conversion; the job reports the result."""
        try:
            name = _WORLD_NAME.validate_python(request.query_params.get("name", ""))
        except ValidationError as error:
            return PlainTextResponse(f"the world's name: {describe(error)}\n", 400)
        if not self._seat.knows(request.headers.get("smal-seat", "")):
            return PlainTextResponse(_NOT_THEIRS, 403)
        try:
            # The file has no name, so it is deleted after its last user, however that ends.
            with tempfile.TemporaryFile() as upload:
                async with asyncio.timeout(_UPLOAD_S):
                    await self._receive(request, upload)
                await self._do(self._service.make_world, name, upload)
        except TimeoutError:
            return PlainTextResponse(f"timeout: the upload took longer than {_UPLOAD_S:g} s\n", 408)
        except ClientDisconnect as gone:
            raise HTTPException(400) from gone
        except OSError as error:
            return PlainTextResponse(f"upload not saved: {error.strerror}\n", 507)
        return PlainTextResponse("taken\n", 202)

    async def _receive(self, request: Request, file: IO[bytes]) -> None:
        """Write an upload to a file while the sender drives and starts no other upload."""
        self._uploads += 1
        mine = self._uploads
        size = 0
        head = b""
        word = request.headers.get("smal-seat", "")
        async for chunk in request.stream():
            if not self._seat.knows(word):
                raise HTTPException(403, _NOT_THEIRS)
            if mine != self._uploads:
                raise HTTPException(409, "replaced by a newer upload\n")
            size += len(chunk)
            head = (head + chunk)[:HEAD_BYTES]
            kind, most = largest_upload(head)
            if size > most:
                raise HTTPException(
                    413, f"{kind} too large (maximum {most / 1e6:.0f} MB); cut it smaller\n"
                )
            await asyncio.to_thread(file.write, chunk)
        await asyncio.to_thread(file.flush)

    async def _watch(self, browser: WebSocket) -> None:
        """Send the latest content, at most one unacknowledged update at a time."""
        await browser.accept()
        seen = asyncio.Event()
        seen.set()

        async def listen() -> None:
            async for message in _messages(browser):
                if isinstance(OF_WATCHERS.validate_json(message), StopRequest):
                    await self._do(self._service.stop)
                elif seen.is_set():
                    raise _NonsenseError("invalid acknowledgement")
                else:
                    seen.set()

        try:
            with self._board.watched() as newest:

                async def send() -> None:
                    while True:
                        text, picture = await newest()
                        seen.clear()
                        await browser.send_text(text)
                        if picture:
                            await browser.send_bytes(picture)
                        await asyncio.sleep(_APART_S)
                        await seen.wait()

                await _until_one_ends(browser, listen(), send())
        except FullError:
            await browser.close(FULL, "too many watch")

    async def _drive(self, browser: WebSocket) -> None:
        """Give a browser the seat while it answers beats."""
        await browser.accept()
        if not self._seat.take(browser):
            await browser.close(TAKEN, "somebody else drives")
            return
        self._board.put("taken", content=True)
        word = self._seat.word  # Later the word can be another driver's.

        async def beat() -> None:
            await browser.send_json({"word": word})
            while self._seat.holds(browser):
                await browser.send_json({"beat": self._seat.beat()})
                await asyncio.sleep(BEAT_S)

        try:
            await _until_one_ends(browser, self._listen(browser), beat())
        finally:
            self._stand_up(browser, self._service.let_go)

    async def _listen(self, browser: WebSocket) -> None:
        """Execute the driver's messages; refuse invalid messages without closing the connection."""
        async for text in _messages(browser):
            if not self._seat.holds(browser):
                return
            try:
                message = OF_DRIVER.validate_json(text)
            except ValidationError as error:
                # The message's kind is internal.
                kind = next(iter(error.errors(include_url=False)[0]["loc"]), "")
                await browser.send_json({"refused": describe(error).removeprefix(f"{kind}.")})
                continue
            if isinstance(message, Hold):
                if (sent_s := self._seat.answered(message.beat)) is not None:
                    await self._do(self._service.hold, message.held, sent_s)
            elif isinstance(message, Leave):
                self._stand_up(browser, self._service.leave)
                return
            elif isinstance(message, StopRequest):
                await self._do(self._service.stop)
            elif (sent_s := self._seat.answered(message.beat)) is not None:
                await self._do(self._service.ask, message, sent_s + LEASE_S)
            else:
                await browser.send_json({"refused": LATE})

    def _stand_up(self, browser: WebSocket, how: Callable[[], None]) -> None:
        if self._seat.holds(browser):
            self._seat.leave(browser)
            self._board.put("taken", content=False)
            self._service.do(how)


class _NonsenseError(ValueError):
    """A browser acknowledged an update that was not sent."""


async def _messages(browser: WebSocket) -> AsyncIterator[str]:
    """Yield the messages of a browser; binary messages count as empty."""
    while (message := await browser.receive())["type"] != "websocket.disconnect":
        yield message.get("text") or ""


async def _until_one_ends(browser: WebSocket, *tasks: Coroutine[Any, Any, None]) -> None:
    """Run the tasks of a connection until one ends, the browser leaves, or a message is invalid."""
    running = [asyncio.ensure_future(task) for task in tasks]
    try:
        await asyncio.wait(running, return_when=asyncio.FIRST_COMPLETED)
        for task in running:
            if task.done():
                task.result()
    except (ValidationError, _NonsenseError) as error:
        with suppress(RuntimeError, WebSocketDisconnect):
            await browser.close(NONSENSE, describe(error)[:100])
    except (WebSocketDisconnect, RuntimeError):
        return  # The browser left during a send.
    finally:
        for task in running:
            task.cancel()
        await asyncio.gather(*running, return_exceptions=True)
    if browser.application_state is WebSocketState.CONNECTED:
        with suppress(RuntimeError, WebSocketDisconnect):
            await browser.close()


def _number(digits: str) -> int | None:
    return int(digits) if digits.isdecimal() and len(digits) <= _DIGITS else None


def _picture(jpeg: bytes | None) -> Response:
    if jpeg is None:
        return PlainTextResponse("picture not found\n", 404)
    # Names and numbers keep their meaning while the page is open.
    return Response(
        jpeg, media_type="image/jpeg", headers={"Cache-Control": "private, max-age=3600"}
    )
