"""Pages of the console that watch."""

from __future__ import annotations

import asyncio
from multiprocessing.connection import Connection

from websockets.asyncio.client import connect


def watch(address: str, count: int, owner: Connection) -> None:
    """Watch until killed; the first page takes nothing of what it is sent."""
    asyncio.run(_watch(address, count, owner))


async def _watch(address: str, count: int, owner: Connection) -> None:
    opened = [await connect(f"ws://{address}/watch", origin=f"http://{address}") for _ in range(count)]  # type: ignore[arg-type]
    for one in opened:
        await one.recv()
    owner.send("watching")
    opened[0].transport.pause_reading()

    async def look(number: int) -> None:
        await opened[number].send('{"do": "seen"}')
        async for message in opened[number]:
            if isinstance(message, str):
                await opened[number].send('{"do": "seen"}')

    await asyncio.gather(*map(look, range(1, count)), asyncio.Event().wait())
