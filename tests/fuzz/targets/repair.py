"""``verify`` and ``repair`` of a damaged recording: clear lines, and a recording without damage or none at all."""

from __future__ import annotations

import random

from services.recordings.repair import RepairError, repair
from services.recordings.stream import RecordingError
from tests.fuzz.targets import check_line, recovery, scratch


def seeds() -> list[bytes]:
    return recovery.seeds()


def run(data: bytes) -> bool:
    path = scratch.file_of(data, "e.mcap")
    out = path.with_name("e-repaired.mcap")
    try:
        (before,), after = repair([path], out)
    except (RecordingError, RepairError) as error:
        check_line(error)
        assert not out.exists()
        return False
    finally:
        out.unlink(missing_ok=True)
    assert path.read_bytes() == data
    for line in [*before.findings, *([] if after is None else after.findings)]:
        check_line(line)
    assert after is None or (after.state == "sealed" and not after.damage)
    return True


def mutate(data: bytes, rng: random.Random) -> bytes | None:
    return recovery.mutate(data, rng)
