"""``EpisodeWriter.resume``: a recording that takes more messages and can be read, or the leftover as it was."""

from __future__ import annotations

import random

from mcap.reader import make_reader

from schemas.episode import Episode
from services.recordings.recovery import RecoveryError
from services.recordings.writer import EpisodeWriter
from tests.fuzz.targets import check_line, mcap_bytes, scratch
from tests.fuzz.targets.recovery import seeds as recovery_seeds


def seeds() -> list[bytes]:
    return recovery_seeds()


def run(data: bytes) -> bool:
    partial = scratch.file_of(data, "e.mcap.partial")
    try:
        writer = EpisodeWriter.resume(partial)
    except RecoveryError as error:
        check_line(error)
        assert partial.read_bytes() == data, "what cannot be gone on with is left as it is"
        partial.unlink()
        return False
    try:
        header = {"robot": "rescuebot", "episode": "e", "tick": 9_999_999, "stamp_ns": 1}
        end = {"event": "ended", "outcome": "aborted", "purpose": "run", "driver": "policy", "world": "w", "seed": 0}
        before = writer.messages
        writer.write(Episode.model_validate(header | end))
        path = writer.seal()
        assert writer.problem is None, writer.problem
        with path.open("rb") as file:
            reader = make_reader(file)
            summary = reader.get_summary()
            assert summary is not None
            assert summary.statistics is not None
            assert summary.statistics.message_count == writer.messages
            assert writer.messages - before <= 1
    finally:
        for path in scratch.folder().glob("e*.mcap*"):
            path.unlink()
    return True


def mutate(data: bytes, rng: random.Random) -> bytes | None:
    return mcap_bytes.mutate(data, rng)
