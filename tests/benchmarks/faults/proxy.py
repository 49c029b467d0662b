"""A link that can go down: a process that passes bytes on between a service and the router.

Frozen, it is a black hole: it accepts nothing, forwards nothing and keeps its connections open, and what was under way
arrives when the link is up again.
"""

from __future__ import annotations

import asyncio
import contextlib
import multiprocessing
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection

from services.bus import host_and_port
from services.commands.errors import JobError

_STARTING_S = 30.0
_STOPPING_S = 2.0


@contextmanager
def link(endpoint: str) -> Iterator[tuple[str, int]]:
    """Run a proxy to a router; give the address to use in the router's place, and the process id."""
    spawn = multiprocessing.get_context("spawn")
    ours, theirs = spawn.Pipe()
    process = spawn.Process(target=forward, args=(endpoint, theirs), daemon=True)
    process.start()
    theirs.close()
    try:
        if not ours.poll(_STARTING_S):
            raise JobError("the link of the benchmark did not start")
        port = ours.recv()
        assert process.pid is not None
        yield f"tcp/127.0.0.1:{port}", process.pid
    except EOFError:
        raise JobError("the link of the benchmark has ended") from None
    finally:
        ours.close()
        process.join(_STOPPING_S)
        process.kill()


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
