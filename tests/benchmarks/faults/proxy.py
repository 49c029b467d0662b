"""A link that can go down: a process that passes bytes on between a service and the router.

Frozen, it is a black hole: it accepts nothing, forwards nothing and keeps its connections open, and what was under way
arrives when the link is up again.
"""

from __future__ import annotations

import asyncio
import contextlib
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection

from services.kit.bus import host_and_port
from tests.benchmarks.faults.child import child


@contextmanager
def link(endpoint: str) -> Iterator[tuple[str, int]]:
    """Run a proxy to a router; give the address to use in the router's place, and the process id."""
    with child("the link of the benchmark", forward, endpoint) as (pid, port):
        yield f"tcp/127.0.0.1:{port}", pid


def forward(endpoint: str, owner: Connection) -> None:
    """Forward connections until the owner of the pipe closes it, or dies."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the owner
    asyncio.run(_forward(endpoint, owner))


async def _forward(endpoint: str, owner: Connection) -> None:
    host, port = host_and_port(endpoint)

    async def connect(client: asyncio.StreamReader, to_client: asyncio.StreamWriter) -> None:
        try:
            router, to_router = await asyncio.open_connection(host, port)
        except OSError:
            to_client.close()
            return
        await asyncio.gather(_pass_on(client, to_router), _pass_on(router, to_client))

    server = await asyncio.start_server(connect, "127.0.0.1", 0)
    owner.send(server.sockets[0].getsockname()[1])
    ended = asyncio.Event()
    asyncio.get_running_loop().add_reader(owner.fileno(), ended.set)
    await ended.wait()


async def _pass_on(source: asyncio.StreamReader, target: asyncio.StreamWriter) -> None:
    with contextlib.suppress(OSError):
        while data := await source.read(65536):
            target.write(data)
            await target.drain()
    with contextlib.suppress(OSError):
        target.close()
