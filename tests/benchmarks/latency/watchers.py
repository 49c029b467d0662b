"""Pages that watch: ``python -m tests.benchmarks.latency.watchers ADDRESS COUNT`` until it is ended."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from websockets.asyncio.client import connect


@contextmanager
def watching(address: str, count: int) -> Iterator[None]:
    """Have pages watch, in a process of their own; the first one takes nothing of what it is sent."""
    command = [sys.executable, "-m", __name__, address, str(count)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            if process.stdout is None or process.stdout.readline() != "watching\n":
                raise OSError(f"no page can watch at {address}")
            yield
        finally:
            process.terminate()


async def _watch(address: str, count: int) -> None:
    opened = [await connect(f"ws://{address}/watch", origin=f"http://{address}") for _ in range(count)]  # type: ignore[arg-type]
    for one in opened:
        await one.recv()
    sys.stdout.write("watching\n")
    sys.stdout.flush()
    opened[0].transport.pause_reading()

    async def look(number: int) -> None:
        await opened[number].send('{"do": "seen"}')
        async for message in opened[number]:
            if isinstance(message, str):
                await opened[number].send('{"do": "seen"}')

    await asyncio.gather(*map(look, range(1, count)))


if __name__ == "__main__":
    asyncio.run(_watch(sys.argv[1], int(sys.argv[2])))
