"""``smal import rosbag2`` of a bag's file."""

from __future__ import annotations

import random
from functools import cache

from services.recordings.records import MAGIC
from tests.fuzz.targets import imported, mcap_bytes, scratch
from tests.services.importers import sources

#: So many hundredths of a second of the drive: inputs are to be small.
_SHORT = 31


@cache
def seeds() -> list[bytes]:
    found = []
    for kind, sqlite, packed in (("mcap", False, False), ("mcap", False, True), ("db3", True, False)):
        bag = sources.rosbag2(
            scratch.folder() / f"{kind}{packed}", sqlite=sqlite, packed=packed, hundredths=_SHORT, raw=None
        )
        found += [path.read_bytes() for path in bag.glob(f"*.{kind}")]
    return found


def run(data: bytes) -> bool:
    suffix = "db3" if data.startswith(b"SQLite") else "mcap"
    return imported.accepted("rosbag2", scratch.file_of(data, f"bag.{suffix}"))


def mutate(data: bytes, rng: random.Random) -> bytes | None:
    return mcap_bytes.mutate(data, rng) if data.startswith(MAGIC) else None
