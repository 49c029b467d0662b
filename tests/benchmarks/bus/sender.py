"""The sending side of the benchmark of the bus: one message at a time, each awaited in the receiving process."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final

from schemas.base import Message
from schemas.codec import encode
from services.cli.bench import FOLDER
from services.cli.stack.child import tied
from services.kit.bus import Bus
from services.kit.errors import JobError
from services.kit.zenoh_wire import ZenohWire
from tests.benchmarks.bus.messages import Case
from tests.benchmarks.bus.receiver import ARRIVAL, CALLBACK, NODE, beside

#: The routes of declarations, and a message of a busy machine, take less; what takes longer is lost.
_PATIENCE_S: Final = 5.0
_STARTING_S: Final = 60.0
_RECEIVE: Final = "import sys; sys.path.insert(0, sys.argv[1]); from tests.benchmarks.bus.receiver import main; main()"
Send = Callable[[], object]
#: Sends a message and waits for it; returns the time one way and what both processes worked, nanoseconds.
Exchange = Callable[[], tuple[int, int]]


class Wire:
    """Sends, and waits for the arrival.

    Parameters
    ----------
    arrivals
        What the receiving process tells.
    """

    def __init__(self, arrivals: Connection) -> None:
        self._arrivals = arrivals
        self._receiver_ns = 0

    def exchange(self, send: Send) -> tuple[int, int]:
        """Send a message.

        Returns
        -------
        one_way_ns, processor_ns
            From before ``send`` to the message at the receiver, and what both processes worked meanwhile.

        Raises
        ------
        JobError
            It did not arrive.
        """
        sender_ns = time.process_time_ns()
        began_ns = time.monotonic_ns()
        send()
        if not self._arrivals.poll(_PATIENCE_S):
            raise JobError("a message of the benchmark did not arrive; is the machine too busy?")
        arrived_ns, receiver_ns = ARRIVAL.unpack(self._arrivals.recv_bytes())
        worked_ns = time.process_time_ns() - sender_ns + receiver_ns - self._receiver_ns
        self._receiver_ns = receiver_ns
        return arrived_ns - began_ns, worked_ns


@contextmanager
def receiver(endpoint: str, secure: Path | None = None) -> Iterator[Wire]:
    """Run the receiving process for as long as the context lasts, with certificates if a folder of them is given."""
    ours, theirs = multiprocessing.Pipe()
    pipe = theirs.fileno()
    command = tied(sys.executable, "-P", "-c", _RECEIVE, str(FOLDER.parents[1]), endpoint, str(pipe))
    environment = os.environ | ({} if secure is None else {"SMAL_SECURE": str(secure)})
    with subprocess.Popen(command, pass_fds=(pipe,), env=environment) as process:
        theirs.close()
        try:
            yield _connect(ours)
        except EOFError:
            raise JobError("the receiving process of the benchmark has ended") from None
        finally:
            ours.close()
            _end(process)


def _connect(arrivals: Connection) -> Wire:
    if not arrivals.poll(_STARTING_S):
        raise JobError("the receiving process of the benchmark did not start")
    arrivals.recv_bytes()
    return Wire(arrivals)


def _end(process: subprocess.Popen[bytes]) -> None:
    """Wait for the process, which sees that its pipe is closed."""
    try:
        process.wait(_PATIENCE_S)
    except subprocess.TimeoutExpired:
        process.kill()


class Senders:
    """Every way to send the message of a case.

    Parameters
    ----------
    endpoint
        The router's address.
    """

    def __init__(self, endpoint: str) -> None:
        self._callback = Bus(CALLBACK, endpoint)
        self._node = Bus(NODE, endpoint)

    def of(self, case: Case) -> Mapping[str, Send]:
        """Return them by name: bytes alone, then ours."""
        causes = [Message(robot=bus.robot, episode="e", tick=7, stamp_ns=time.time_ns()) for bus in self._buses]
        to_callback, to_node = (case.build(cause) for cause in causes)
        payload = encode(to_callback)
        # What is not recorded gets an ordinary publisher, with the quality of service of the topic.
        wire = self._callback._wire
        assert isinstance(wire, ZenohWire)
        plain = wire.declare_publisher(replace(beside(case.topic, "plain"), recorded=False))
        same = wire.declare_publisher(beside(case.topic, "same publisher"))
        return {
            "plain": lambda: plain.put(payload),
            "same publisher": lambda: same.put(payload),
            "callback": lambda: self._callback.publish(to_callback),
            "ours": lambda: self._node.publish(to_node),
            "built": lambda: self._node.publish(case.build(causes[1])),
        }

    @property
    def _buses(self) -> tuple[Bus, Bus]:
        return self._callback, self._node

    def close(self) -> None:
        """Leave the bus."""
        for bus in self._buses:
            bus.close()
