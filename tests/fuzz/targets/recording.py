"""``read_recording`` and what teaching does with its answer."""

from __future__ import annotations

import random

from mcap.writer import CompressionType

from services.recordings.reader import read_recording
from services.recordings.stream import RecordingError
from tests.fuzz.targets import check_line, mcap_bytes, scratch
from tests.services.recordings.recorded_messages import FEATURES, FINGERPRINT


def seeds() -> list[bytes]:
    whole = [mcap_bytes.recording(compression) for compression in CompressionType]
    return [*whole, mcap_bytes.recording(finished=False), whole[0][:400]]


def run(data: bytes) -> bool:
    try:
        recording = read_recording(scratch.file_of(data, "e.mcap"), FINGERPRINT)
    except RecordingError as error:
        check_line(error)
        return False
    assert any(episode.frames for episode in recording.episodes)
    for episode in recording.episodes:
        # As teaching does: vectors of another size are as good as none.
        episode.features = {tick: v for tick, v in episode.features.items() if v.shape == (FEATURES,)}
        assert sum(piece.ticks.size for piece in episode.pieces()) <= len(episode.features)
    return True


def mutate(data: bytes, rng: random.Random) -> bytes | None:
    return mcap_bytes.mutate(data, rng)
