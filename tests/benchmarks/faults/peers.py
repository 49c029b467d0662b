"""Clients beside the stack: an operator who looks on, or drives; and a client that takes nothing."""

import contextlib
import math
import os
import threading
import time
from multiprocessing.connection import Connection

from schemas.base import KEYS
from schemas.topics import LANES, ROOT
from services.kit.bus import Bus
from services.kit.node import Node
from services.kit.settings import ServiceSettings
from services.operator.operator import POLL_S, Operator


def look_on(robot: str, endpoint: str, owner: Connection) -> None:
    """Be an operator as `smal teleop` and the page are, until killed."""
    with Node("teleop", ServiceSettings(robot=robot, router=endpoint)) as node:
        operator = Operator(node, node.log.info)
        node.every(POLL_S, operator.poll)
        threading.Thread(target=_end_with, args=(owner,), daemon=True).start()
        owner.send("ready")
        node.spin()


def drive_by_hand(robot: str, endpoint: str, owner: Connection) -> None:
    """Take over from the policy, as an operator who holds a key, until killed."""
    with Node("teleop", ServiceSettings(robot=robot, router=endpoint)) as node:
        operator = Operator(node, node.log.info)

        def drive() -> None:
            operator.poll()
            if operator.commands.held is None:  # Turning on the spot touches nothing.
                operator.hold(KEYS["left"], math.inf)

        node.every(POLL_S, drive)
        threading.Thread(target=_end_with, args=(owner,), daemon=True).start()
        owner.send("ready")
        node.spin()


def consume_slowly(robot: str, endpoint: str, owner: Connection) -> None:
    """Block in the first callback, until killed."""
    bus = Bus(robot, endpoint)
    bus.wait_connected(10.0)
    for lane in LANES:
        bus.listen(f"{ROOT}/**", lambda *_sample: time.sleep(3600.0), lane=lane)
    owner.send("ready")
    _end_with(owner)


def _end_with(owner: Connection) -> None:
    """End at once: the session cannot be closed where its thread hangs in a callback."""
    with contextlib.suppress(EOFError, OSError):
        owner.recv_bytes()
    os._exit(0)
