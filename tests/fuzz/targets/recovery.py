"""``EpisodeWriter.resume`` and ``seal`` of a leftover: a recording that can be read, or the leftover as it was."""

from __future__ import annotations

import random
from pathlib import Path

from mcap.reader import make_reader

from schemas.episode import Episode
from services.recordings.reader import RecordingError, read_recording
from services.recordings.records import MAGIC
from services.recordings.views import is_view
from services.recordings.writer import EpisodeWriter, RecoveryError
from tests.fuzz.targets import check_line, mcap_bytes, scratch


def seeds() -> list[bytes]:
    unfinished = mcap_bytes.recording(finished=False)
    return [unfinished, unfinished[:-7], unfinished + bytes(30), mcap_bytes.recording(), MAGIC, MAGIC[:3]]


def run(data: bytes) -> bool:
    partial = scratch.file_of(data, "e.mcap.partial")
    try:
        try:
            writer = EpisodeWriter.resume(partial)
        except RecoveryError as error:
            check_line(error)
            assert partial.read_bytes() == data if partial.exists() else MAGIC.startswith(data)
            return False
        header = {"robot": "rescuebot", "episode": "e", "tick": 9_999_999, "stamp_ns": 1}
        end = {"event": "ended", "outcome": "aborted", "purpose": "run", "driver": "policy", "world": "w", "seed": 0}
        writer.write(Episode.model_validate(header | end))
        path = writer.seal()
        if path == partial:
            check_line(str(writer.problem))
            assert partial.read_bytes() == data, "what cannot be merged is left as it is"
            return False
        _check(path, writer.messages)
        return True
    finally:
        for left in scratch.folder().glob("e*.mcap*"):
            left.unlink()


def _check(path: Path, messages: int) -> None:
    assert not list(path.parent.glob("e*.mcap.partial*"))
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    counts = summary.statistics.channel_message_counts
    own = {number for number, channel in summary.channels.items() if not is_view(channel.topic)}
    assert sum(count for number, count in counts.items() if number in own) == messages
    try:
        assert not read_recording(path).truncated
    except RecordingError as error:
        check_line(error)


def mutate(data: bytes, rng: random.Random) -> bytes | None:
    return mcap_bytes.mutate(data, rng)
