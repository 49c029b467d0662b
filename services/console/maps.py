"""Maps that browsers send, each in a folder of its own until a world is made of it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Final

from pydantic import TypeAdapter, ValidationError
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import PlainTextResponse, Response

from schemas.codec import describe
from schemas.rpc import WorldName
from services.console.folder import Folder, remove_left_over
from services.console.who_drives import Seat

#: Most bytes of a map, as `smal world import` has it; and how long it may take to come: at 2 Mbit/s and more.
_LARGEST_MAP: Final = 64 << 20
_UPLOAD_S: Final = 300
_NOT_THEIRS: Final = "only who drives may do that: take control first\n"
_WORLD_NAME: Final[TypeAdapter[str]] = TypeAdapter(WorldName)


class Maps:
    """Takes maps from whoever drives, to make worlds of them; what becomes of that is told as a job.

    Parameters
    ----------
    make
        Makes a world of a name of the map in a folder, which it closes; done when its future ends.
    seat
        Who drives.
    """

    def __init__(self, make: Callable[[str, Path, Folder], Future[None]], seat: Seat) -> None:
        self._make = make
        self._seat = seat
        #: How many were begun to be sent.
        self._begun = 0
        remove_left_over()

    async def take(self, request: Request) -> Response:
        """Take a map."""
        try:
            name = _WORLD_NAME.validate_python(request.query_params.get("name", ""))
        except ValidationError as error:
            return PlainTextResponse(f"the world's name: {describe(error)}\n", 400)
        if not self._seat.knows(request.headers.get("smal-seat", "")):
            return PlainTextResponse(_NOT_THEIRS, 403)
        try:
            with ExitStack() as needs:
                folder = Folder()
                needs.enter_context(closing(folder))
                osm_map = folder.path / f"{name}.osm"
                async with asyncio.timeout(_UPLOAD_S):
                    await self._receive(request, osm_map)
                needs.pop_all()
                await asyncio.wrap_future(self._make(name, osm_map, folder))
        except TimeoutError:
            return PlainTextResponse(f"the map took longer than {_UPLOAD_S:g} s\n", 408)
        except ClientDisconnect as gone:
            raise HTTPException(400) from gone
        except OSError as error:
            return PlainTextResponse(f"the map cannot be kept: {error.strerror}\n", 507)
        return PlainTextResponse("taken\n", 202)

    async def _receive(self, request: Request, file: Path) -> None:
        """Write what is sent into a file, while whoever sends it drives, and has not begun to send another one."""
        self._begun += 1
        mine, size, word = self._begun, 0, request.headers.get("smal-seat", "")
        with file.open("wb") as out:
            async for chunk in request.stream():
                if not self._seat.knows(word):
                    raise HTTPException(403, _NOT_THEIRS)
                if mine != self._begun:
                    raise HTTPException(409, "another map was sent after this one\n")
                size += len(chunk)
                if size > _LARGEST_MAP:
                    raise HTTPException(413, f"a map has at most {_LARGEST_MAP / 1e6:.0f} MB; cut it smaller\n")
                await asyncio.to_thread(out.write, chunk)
