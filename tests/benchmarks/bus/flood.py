"""A process that floods a router: with a watcher's certificate it publishes commands, which a watcher may not."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Final

import zenoh

from schemas.topics import COMMANDS
from services.kit.credentials import credentials_in
from tests.benchmarks.bus.receiver import NODE
from tests.services.secured import open_session

#: Of one process; more comes from several.
RATE_HZ: Final = 10_000
#: As long as a command is, and as urgent.
_SIZE: Final = 200


def main() -> None:
    """Flood until killed; says on standard output how many a second, once a second."""
    endpoint, keys = sys.argv[-2:]
    session = open_session(endpoint, credentials_in(Path(keys), "watcher"))
    key, payload = COMMANDS["policy"].key(NODE), bytes(_SIZE)
    sent, began_s, told_s = 0, time.monotonic(), time.monotonic()
    while True:
        session.put(
            key, payload, priority=zenoh.Priority.REAL_TIME, express=True,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )  # fmt: skip
        sent += 1
        now_s = time.monotonic()
        if now_s - told_s >= 1.0:
            sys.stdout.write(f"{sent / (now_s - began_s):.0f}\n")
            sys.stdout.flush()
            told_s = now_s
        time.sleep(max(0.0, began_s + sent / RATE_HZ - now_s - 1e-3))
