"""A link that can go down, or grow slow: a process that passes bytes on between a service and the router.

Frozen, it is a black hole: it accepts nothing, forwards nothing and keeps its connections open, and what was under way
arrives when the link is up again. From a SIGUSR1 on it grows slow: whatever is sent takes ever longer, each way.
"""

import asyncio
import contextlib
import math
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import Final

from services.kit.bus import host_and_port
from tests.benchmarks.child import child

#: How late a slow link is at last, each way, and by how much later what is sent a second later: so slowly that what
#: is sent 20 times a second arrives several times a second all the time.
LATE_S: Final = 3.0
GROWTH: Final = 0.5
_UNDER_WAY: Final = 1024  # Most pieces under way, of 64 KiB at most.


@contextmanager
def link(endpoint: str) -> Iterator[tuple[str, int]]:
    """Run a proxy to a router; give the address to use in the router's place, and the process id."""
    with child("the link of the benchmark", forward, endpoint) as proxy:
        yield f"tcp/127.0.0.1:{proxy.said}", proxy.pid


def forward(endpoint: str, owner: Connection) -> None:
    """Forward connections until the owner of the pipe closes it, or dies."""
    asyncio.run(_forward(endpoint, owner))


async def _forward(endpoint: str, owner: Connection) -> None:
    host, port = host_and_port(endpoint)
    slow_from_s = math.inf

    def late_s() -> float:
        return min(LATE_S, GROWTH * max(0.0, time.monotonic() - slow_from_s))

    def grow_slow() -> None:
        nonlocal slow_from_s
        slow_from_s = time.monotonic()

    asyncio.get_running_loop().add_signal_handler(signal.SIGUSR1, grow_slow)

    async def connect(client: asyncio.StreamReader, to_client: asyncio.StreamWriter) -> None:
        try:
            router, to_router = await asyncio.open_connection(host, port)
        except OSError:
            to_client.close()
            return
        await asyncio.gather(_pass_on(client, to_router, late_s), _pass_on(router, to_client, late_s))

    server = await asyncio.start_server(connect, "127.0.0.1", 0)
    owner.send(server.sockets[0].getsockname()[1])
    ended = asyncio.Event()
    asyncio.get_running_loop().add_reader(owner.fileno(), ended.set)
    await ended.wait()


async def _pass_on(source: asyncio.StreamReader, target: asyncio.StreamWriter, late_s: Callable[[], float]) -> None:
    """Pass bytes on, and their end, each when it is due."""
    under_way: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(_UNDER_WAY)

    async def take() -> None:
        data = b"begun"
        while data:
            data = b""
            with contextlib.suppress(OSError):
                data = await source.read(65536)
            await under_way.put((time.monotonic() + late_s(), data))

    taking = asyncio.ensure_future(take())
    with contextlib.suppress(OSError):
        while True:
            due_s, data = await under_way.get()
            await asyncio.sleep(max(0.0, due_s - time.monotonic()))
            if not data:
                break
            target.write(data)
            await target.drain()
    taking.cancel()
    with contextlib.suppress(OSError):
        target.close()
