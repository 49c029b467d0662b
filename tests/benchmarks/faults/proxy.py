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
from dataclasses import dataclass
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

    async def run() -> None:
        await _Forwarder(endpoint, _batch if batches else _piece, owner).run()

    asyncio.run(run())


#: Key of a sign of life: the lanes that it leaves and reaches its process by.
_ECHO: Final = re.compile(echo_key("[a-z]+", "[0-9a-f]+", "([a-z]+)", "([a-z]+)").encode())
_Read = Callable[[asyncio.StreamReader], Awaitable[bytes]]


class _Passing:
    """One connection: its ends, which lanes it may be, and in which directions it carries nothing."""

    def __init__(self, to_client: asyncio.StreamWriter, to_router: asyncio.StreamWriter) -> None:
        self.to_client = to_client
        self.to_router = to_router
        self.lanes = set[str](LANES)
        self.swallows: set[asyncio.StreamWriter] = set()

    def note(self, target: asyncio.StreamWriter, data: bytes) -> None:
        """Learn which lane this is: every sign of life that the client declares leaves or reaches it by that."""
        if target is self.to_router and len(self.lanes) > 1:
            for ends in _ECHO.findall(data):
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

    async def keep_alive(self, target: asyncio.StreamWriter) -> None:
        """Keep a connection open that carries nothing."""
        while True:
            await asyncio.sleep(_KEEP_ALIVE_S)
            if target in self.swallows:
                target.write(_KEEP_ALIVE)


class _Forwarder:
    """All connections of a link, and what its owner has done to them."""

    def __init__(self, endpoint: str, read: _Read, owner: Connection) -> None:
        self._router = host_and_port(endpoint)
        self._read = read
        self._owner = owner
        self._slow_from_s = math.inf
        self._refuses = False
        self._passing: list[_Passing] = []
        self._ended = asyncio.Event()

    async def run(self) -> None:
        loop = asyncio.get_running_loop()
        loop.add_signal_handler(signal.SIGUSR1, self._grow_slow)
        server = await asyncio.start_server(self._connect, "127.0.0.1", 0)
        self._owner.send(server.sockets[0].getsockname()[1])
        loop.add_reader(self._owner.fileno(), self._obey)
        await self._ended.wait()

    def _late_s(self) -> float:
        return min(LATE_S, GROWTH * max(0.0, time.monotonic() - self._slow_from_s))

    def _grow_slow(self) -> None:
        self._slow_from_s = time.monotonic()

    def _obey(self) -> None:
        """Carry out an order of the owner: harm a lane, or mend what was harmed."""
        try:
            order = self._owner.recv()
        except EOFError:
            self._ended.set()
            return
        self._refuses = order is not None
        if order is None:
            for one in [one for one in self._passing if one.swallows]:
                one.close()
        else:
            harm, lane = order
            for one in [one for one in self._passing if one.lanes == {lane}]:
                one.harm(harm)
        self._owner.send("done")

    async def _connect(self, client: asyncio.StreamReader, to_client: asyncio.StreamWriter) -> None:
        try:
            if self._refuses:
                raise ConnectionRefusedError
            router, to_router = await asyncio.open_connection(*self._router)
        except OSError:
            to_client.close()
            return
        one = _Passing(to_client, to_router)
        self._passing.append(one)
        with contextlib.suppress(asyncio.CancelledError):  # as the link ends
            await asyncio.gather(
                self._pass_on(client, to_router, one), self._pass_on(router, to_client, one)
            )
        self._passing.remove(one)

    async def _pass_on(
        self, source: asyncio.StreamReader, target: asyncio.StreamWriter, passing: _Passing
    ) -> None:
        """Pass on what comes, and the end of the stream, each when it is due."""
        under_way: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(_UNDER_WAY)

        async def take() -> None:
            data = b"begun"
            while data:
                data = await self._read(source)
                passing.note(target, data)
                await under_way.put((time.monotonic() + self._late_s(), data))

        working = [asyncio.ensure_future(task) for task in (take(), passing.keep_alive(target))]
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
