"""What the page is answered: files, pictures, maps that it sends, and two sockets, one to watch and one to drive."""

import asyncio
import tempfile
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, Final

from pydantic import TypeAdapter, ValidationError
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from schemas.codec import describe
from schemas.rpc import WorldName
from services.console.browser_messages import LATE, OF_DRIVER, OF_WATCHERS, Hold, Leave, StopRequest
from services.console.guard import MAP
from services.console.newest_content import Board, FullError
from services.console.service import ConsoleService
from services.console.who_drives import BEAT_S, LEASE_S, Seat

PAGE: Final = Path(__file__).parent / "page"
_APART_S: Final = 0.05  # A watcher is sent something at most so often.
# Of a socket: too many watch; somebody else drives; it makes no sense.
FULL = 4001
TAKEN = 4002
NONSENSE = 4003
_DIGITS: Final = 9  # Digits of the number of a picture, at most.
#: Most bytes of a map, as `smal world import` has it; and how long it may take to come: at 2 Mbit/s and more.
_LARGEST_MAP: Final = 64 << 20
_UPLOAD_S: Final = 300
_NOT_THEIRS: Final = "only who drives may do that: take control first\n"
_WORLD_NAME: Final[TypeAdapter[str]] = TypeAdapter(WorldName)


class Web:
    """Answers browsers, in one event loop.

    What a person does is done when its future ends, and their browser is heard further then: so nothing waits behind
    more than one thing that each has said, be it an emergency stop behind a flood.
    """

    def __init__(self, service: ConsoleService, board: Board) -> None:
        self._service = service
        self._board = board
        self._seat = Seat(board.clock)
        self._maps = 0  # How many maps were begun to be sent.

    def application(self) -> Starlette:
        """Return what answers; without its guard."""
        return Starlette(
            routes=[
                Route("/thumbnail", self._thumbnail),
                Route(MAP, self._take_map, methods=["POST"]),
                Route("/taught/{model}/{keyframe}", self._taught),
                WebSocketRoute("/watch", self._watch),
                WebSocketRoute("/drive", self._drive),
                Mount("/", StaticFiles(directory=PAGE, html=True)),
            ]
        )

    def _do(self, what: Callable[..., None], *arguments: object) -> asyncio.Future[None]:
        return asyncio.wrap_future(self._service.do(what, *arguments))

    async def _thumbnail(self, request: Request) -> Response:
        """Answer with a small picture of a recording; its name is looked for in the list, and opens nothing."""
        recording = self._service.library.recording(request.query_params.get("of", ""))
        number = _number(request.query_params.get("k", ""))
        if recording is None or number is None or number >= len(recording.thumbnails):
            return _picture(None)
        return _picture(recording.thumbnails[number])

    async def _taught(self, request: Request) -> Response:
        learned = self._service.live.learned
        keyframe = _number(request.path_params["keyframe"])
        if learned is None or keyframe is None or learned.identity != request.path_params["model"]:
            return _picture(None)
        return _picture(learned.image(keyframe))

    async def _take_map(self, request: Request) -> Response:
        """Take a map from whoever drives, to make a world of it; what becomes of that is told as a job."""
        try:
            name = _WORLD_NAME.validate_python(request.query_params.get("name", ""))
        except ValidationError as error:
            return PlainTextResponse(f"the world's name: {describe(error)}\n", 400)
        if not self._seat.knows(request.headers.get("smal-seat", "")):
            return PlainTextResponse(_NOT_THEIRS, 403)
        try:
            # It has no name in any folder, and is gone when nobody has it open any more, however they end.
            with tempfile.TemporaryFile() as osm_map:
                async with asyncio.timeout(_UPLOAD_S):
                    await self._receive(request, osm_map)
                await self._do(self._service.make_world, name, osm_map)
        except TimeoutError:
            return PlainTextResponse(f"the map took longer than {_UPLOAD_S:g} s\n", 408)
        except ClientDisconnect as gone:
            raise HTTPException(400) from gone
        except OSError as error:
            return PlainTextResponse(f"the map cannot be kept: {error.strerror}\n", 507)
        return PlainTextResponse("taken\n", 202)

    async def _receive(self, request: Request, file: IO[bytes]) -> None:
        """Write what is sent into a file, while whoever sends it drives, and has not begun to send another one."""
        self._maps += 1
        mine = self._maps
        size = 0
        word = request.headers.get("smal-seat", "")
        async for chunk in request.stream():
            if not self._seat.knows(word):
                raise HTTPException(403, _NOT_THEIRS)
            if mine != self._maps:
                raise HTTPException(409, "another map was sent after this one\n")
            size += len(chunk)
            if size > _LARGEST_MAP:
                raise HTTPException(
                    413, f"a map has at most {_LARGEST_MAP / 1e6:.0f} MB; cut it smaller\n"
                )
            await asyncio.to_thread(file.write, chunk)
        await asyncio.to_thread(file.flush)

    async def _watch(self, browser: WebSocket) -> None:
        """Send the newest, and more when that was seen: at most one message is on its way, however slow that is."""
        await browser.accept()
        seen = asyncio.Event()
        seen.set()

        async def listen() -> None:
            async for said in _said(browser):
                if isinstance(OF_WATCHERS.validate_json(said), StopRequest):
                    await self._do(self._service.stop)
                elif seen.is_set():
                    raise _NonsenseError("there is nothing more to be seen")
                else:
                    seen.set()

        try:
            with self._board.watched() as newest:

                async def tell() -> None:
                    while True:
                        text, picture = await newest()
                        seen.clear()
                        await browser.send_text(text)
                        if picture:
                            await browser.send_bytes(picture)
                        await asyncio.sleep(_APART_S)
                        await seen.wait()

                await _until_one_ends(browser, listen(), tell())
        except FullError:
            await browser.close(FULL, "too many watch")

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
            self._stand_up(browser, self._service.let_go)

    async def _listen(self, browser: WebSocket) -> None:
        """Do what whoever drives says while they have the seat; of nonsense they are told, which loses no robot."""
        async for text in _said(browser):
            if not self._seat.holds(browser):
                return
            try:
                said = OF_DRIVER.validate_json(text)
            except ValidationError as error:
                # What kind of message it came in means nothing to who asked.
                kind = next(iter(error.errors(include_url=False)[0]["loc"]), "")
                await browser.send_json({"refused": describe(error).removeprefix(f"{kind}.")})
                continue
            if isinstance(said, Hold):
                if (sent_s := self._seat.answered(said.beat)) is not None:
                    await self._do(self._service.hold, said.held, sent_s)
            elif isinstance(said, Leave):
                self._stand_up(browser, self._service.leave)
                return
            elif isinstance(said, StopRequest):
                await self._do(self._service.stop)
            elif (sent_s := self._seat.answered(said.beat)) is not None:
                await self._do(self._service.ask, said, sent_s + LEASE_S)
            else:
                await browser.send_json({"refused": LATE})

    def _stand_up(self, browser: WebSocket, how: Callable[[], None]) -> None:
        if self._seat.holds(browser):
            self._seat.leave(browser)
            self._board.put("taken", content=False)
            self._service.do(how)


class _NonsenseError(Exception):
    """A browser says what is no answer to what it was sent."""


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


def _picture(jpeg: bytes | None) -> Response:
    if jpeg is None:
        return PlainTextResponse("no such picture\n", 404)
    # What a name or a number stands for does not change while the page is open.
    return Response(
        jpeg, media_type="image/jpeg", headers={"Cache-Control": "private, max-age=3600"}
    )
