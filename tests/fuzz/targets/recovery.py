"""``seal_leftover``: a recording that can be read, or the leftover as it was."""

from __future__ import annotations

import random
from pathlib import Path

from mcap.reader import make_reader

from schemas.base import Message
from services.recordings.leftover import LeftoverError, seal_leftover
from services.recordings.reader import read_recording
from services.recordings.records import MAGIC
from services.recordings.sink import partial_of
from services.recordings.stream import RecordingError
from services.recordings.writer import EpisodeWriter
from tests.fuzz.targets import check_line, mcap_bytes, scratch
from tests.services.recordings.recorded_messages import applied, event, observation


def seeds() -> list[bytes]:
    older = mcap_bytes.recording(finished=False)
    whole = left(
        [event("e", 0, "started"), *(one for k in range(13) for one in (observation("e", k), applied("e", k)))]
    )
    return [whole, whole[:-7], whole + bytes(30), older, older[:-7], mcap_bytes.recording(), MAGIC, MAGIC[:3]]


def left(messages: list[Message]) -> bytes:
    """Return what a recorder leaves that is killed."""
    writer = EpisodeWriter.begin(scratch.folder(), event("left", 0, "started"))
    for message in messages:
        writer.write(message)
    try:
        writer.flush()
        return partial_of(writer.path).read_bytes()
    finally:
        writer.seal().unlink()


def run(data: bytes) -> bool:
    partial = scratch.file_of(data, "e.mcap.partial")
    try:
        sealed = seal_leftover(partial)
    except LeftoverError as error:
        check_line(error)
        assert partial.read_bytes() == data
        return False
    else:
        assert not partial.exists()
        if sealed.path is not None:
            _check(sealed.path)
        return sealed.path is not None
    finally:
        for found in scratch.folder().glob("e*.mcap*"):
            found.unlink()


def _check(path: Path) -> None:
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.chunk_count == len(summary.chunk_indexes)
    try:
        assert not read_recording(path).truncated
    except RecordingError as error:
        check_line(error)


def mutate(data: bytes, rng: random.Random) -> bytes | None:
    return mcap_bytes.mutate(data, rng)
