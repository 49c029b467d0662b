"""``recover`` of a folder with a leftover: a recording that can be read, or the leftover as it was and a reason."""

from __future__ import annotations

import random

from mcap.reader import make_reader

from services.recordings.reader import RecordingError, read_recording
from services.recordings.records import MAGIC
from services.recordings.recovery import Recovered, recover
from tests.fuzz.targets import check_line, mcap_bytes, scratch


def seeds() -> list[bytes]:
    unfinished = mcap_bytes.recording(finished=False)
    return [unfinished, unfinished[:-7], unfinished + bytes(30), mcap_bytes.recording(), MAGIC, MAGIC[:3]]


def run(data: bytes) -> bool:
    scratch.file_of(data, "e.mcap.partial")
    try:
        (recovered,) = recover(scratch.folder())
        return _check(data, recovered)
    finally:
        for path in scratch.folder().glob("e*.mcap*"):
            path.unlink()


def _check(data: bytes, recovered: Recovered) -> bool:
    if recovered.problem is not None:
        check_line(recovered.problem)
        assert recovered.partial.read_bytes() == data, "what cannot be recovered is left as it is"
        return False
    assert not recovered.partial.exists()
    if recovered.path is None:
        assert MAGIC.startswith(data), "only an empty leftover may vanish"
        return True
    with recovered.path.open("rb") as file:
        assert make_reader(file).get_summary() is not None
    try:
        assert not read_recording(recovered.path).truncated
    except RecordingError as error:
        check_line(error)
    return True


def mutate(data: bytes, rng: random.Random) -> bytes | None:
    return mcap_bytes.mutate(data, rng)
