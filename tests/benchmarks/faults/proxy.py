"""A link that can go down, grow slow, or lose one lane: a process that forwards bytes between a service and the router.

Frozen, it is a black hole: it accepts nothing, forwards nothing and keeps its connections open, and what was under way
arrives when the link is up again. From a SIGUSR1 on it grows slow: whatever is sent takes ever longer, each way. It can
harm a single lane of the process behind it, for good, and then refuses all new connections.
"""

import asyncio
import contextlib
import math
import re
import signal
import time
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Final, Literal

from schemas.topics import LANES, Lane, echo_key
from services.kit.bus import host_and_port
from tests.benchmarks.child import Child, child

#: How late a slow link is at last, each way, and by how much later what is sent a second later: so slowly that what
#: is sent 20 times a second arrives several times a second all the time.
LATE_S: Final = 3.0
GROWTH: Final = 0.5
_UNDER_WAY: Final = 1024  # Most pieces under way, of 64 KiB at most.
#: A batch of Zenoh on a stream: two bytes of its length, and one message that keeps the connection open.
_KEEP_ALIVE: Final = b"\x01\x00\x04"
_KEEP_ALIVE_S: Final = 0.25
#: What is done to a lane. Its connection is closed; or it stays open, and nothing comes by it, or nothing goes.
Harm = Literal["cut", "deafen", "mute"]


@dataclass(frozen=True)
class Link:
    """The process of a link."""

    process: Child

    @property
    def address(self) -> str:
        """The address to use in the router's place."""
        return f"tcp/127.0.0.1:{self.process.said}"

    @property
    def pid(self) -> int:
        """Its process id."""
        return self.process.pid

    def harm(self, harm: Harm, lane: Lane) -> None:
        """Harm one lane of the one process that uses this link, and let nothing connect any more."""
        self.process.pipe.send((harm, lane))
        self.process.pipe.recv()

    def mend(self) -> None:
        """Close what was harmed, and let everything connect again."""
        self.process.pipe.send(None)
        self.process.pipe.recv()


@contextmanager
def link(endpoint: str, *, batches: bool = False) -> Iterator[Link]:
    """Run a proxy to a router, or to another server; to harm a lane it has to forward Zenoh's batches as a whole."""
    with child("the link of the benchmark", forward, endpoint, batches) as proxy:
        yield Link(proxy)


def forward(endpoint: str, batches: bool, owner: Connection) -> None:
    """Forward connections until the owner of the pipe closes it, or dies."""
    asyncio.run(_forward(endpoint, _batch if batches else _piece, owner))


#: Key of a sign of life: the lanes that it leaves and reaches its process by.
_ECHO: Final = re.compile(echo_key("[a-z]+", "[0-9a-f]+", "([a-z]+)", "([a-z]+)").encode())
_Read = Callable[[asyncio.StreamReader], Awaitable[bytes]]


@dataclass(eq=False)
class _Passing:
    """One connection: its ends, how it is read, how late it is, and in which directions it carries nothing."""

    to_client: asyncio.StreamWriter
    to_router: asyncio.StreamWriter
    read: _Read
    late_s: Callable[[], float]
    lanes: set[str] = field(default_factory=lambda: set(LANES))  # Which lane it is, as far as that is known.
    swallows: set[asyncio.StreamWriter] = field(default_factory=set)

    def learn(self, data: bytes) -> None:
        """Learn which lane this is: every sign of life that the client declares is from it, or to it."""
        for ends in _ECHO.findall(data) if len(self.lanes) > 1 else ():
            self.lanes &= {end.decode() for end in ends}

    def harm(self, harm: Harm) -> None:
        if harm == "cut":
            self.close()
        else:
            self.swallows.add(self.to_client if harm == "deafen" else self.to_router)

    def close(self) -> None:
        for end in (self.to_client, self.to_router):
            with contextlib.suppress(OSError):
                end.close()


async def _forward(endpoint: str, read: _Read, owner: Connection) -> None:
    host, port = host_and_port(endpoint)
    slow_from_s = math.inf
    refuses = False
    passing: list[_Passing] = []

    def late_s() -> float:
        return min(LATE_S, GROWTH * max(0.0, time.monotonic() - slow_from_s))

    def grow_slow() -> None:
        nonlocal slow_from_s
        slow_from_s = time.monotonic()

    asyncio.get_running_loop().add_signal_handler(signal.SIGUSR1, grow_slow)

    async def connect(client: asyncio.StreamReader, to_client: asyncio.StreamWriter) -> None:
        try:
            if refuses:
                raise ConnectionRefusedError
            router, to_router = await asyncio.open_connection(host, port)
        except OSError:
            to_client.close()
            return
        one = _Passing(to_client, to_router, read, late_s)
        passing.append(one)
        await asyncio.gather(_pass_on(client, to_router, one), _pass_on(router, to_client, one))
        passing.remove(one)

    def obey() -> None:
        nonlocal refuses
        try:
            order = owner.recv()
        except EOFError:
            ended.set()
            return
        refuses = order is not None
        if order is None:
            for one in [one for one in passing if one.swallows]:
                one.close()
        else:
            harm, lane = order
            for one in [one for one in passing if one.lanes == {lane}]:
                one.harm(harm)
        owner.send("done")

    server = await asyncio.start_server(connect, "127.0.0.1", 0)
    owner.send(server.sockets[0].getsockname()[1])
    ended = asyncio.Event()
    asyncio.get_running_loop().add_reader(owner.fileno(), obey)
    await ended.wait()


async def _piece(source: asyncio.StreamReader) -> bytes:
    """Return what has come; nothing at the end of the stream."""
    with contextlib.suppress(OSError):
        return await source.read(65536)
    return b""


async def _batch(source: asyncio.StreamReader) -> bytes:
    """Return the next batch of a stream of Zenoh; nothing at its end."""
    try:
        length = await source.readexactly(2)
        return length + await source.readexactly(int.from_bytes(length, "little"))
    except (OSError, asyncio.IncompleteReadError):
        return b""


async def _pass_on(source: asyncio.StreamReader, target: asyncio.StreamWriter, passing: _Passing) -> None:
    """Pass on what comes, and the end of the stream, each when it is due."""
    under_way: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(_UNDER_WAY)

    async def take() -> None:
        data = b"begun"
        while data:
            data = await passing.read(source)
            if target is passing.to_router:
                passing.learn(data)
            await under_way.put((time.monotonic() + passing.late_s(), data))

    async def keep_alive() -> None:
        while True:
            await asyncio.sleep(_KEEP_ALIVE_S)
            if target in passing.swallows:
                target.write(_KEEP_ALIVE)

    working = [asyncio.ensure_future(task) for task in (take(), keep_alive())]
    with contextlib.suppress(OSError):
        while True:
            due_s, data = await under_way.get()
            await asyncio.sleep(max(0.0, due_s - time.monotonic()))
            if not data:
                break
            if target not in passing.swallows:
                target.write(data)
                await target.drain()
    for task in working:
        task.cancel()
    with contextlib.suppress(OSError):
        target.close()
