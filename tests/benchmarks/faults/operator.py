"""An operator who looks on: a process of its own, with what `smal teleop` and the page tell the robot."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection

from services.kit.node import Node
from services.kit.settings import ServiceSettings
from services.operator.hold import KeyHold
from services.operator.operator import POLL_S, Operator
from services.robot.clock import now_s
from tests.benchmarks.faults.child import child


@contextmanager
def looking_on(robot: str, endpoint: str) -> Iterator[int]:
    """Have an operator there for as long as the context lasts; give the process id."""
    with child("the operator", look_on, robot, endpoint, patience_s=0.0) as (pid, _ready):
        yield pid


def look_on(robot: str, endpoint: str, owner: Connection) -> None:
    """Be there until killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the owner
    with Node("teleop", ServiceSettings(robot=robot, router=endpoint)) as node:
        operator = Operator(node, KeyHold(now_s), node.log.info)
        node.every(POLL_S, operator.poll)
        threading.Thread(target=_end_with, args=(owner,), daemon=True).start()
        owner.send("ready")
        node.spin()


def _end_with(owner: Connection) -> None:
    with contextlib.suppress(EOFError, OSError):
        owner.recv_bytes()
    os._exit(0)
