"""What a recorder wrote is read again, and what it holds in memory meanwhile is bounded."""

import gc
import os
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from schemas.base import TICK_S, Message
from schemas.camera import CompressedImage
from schemas.rpc import Nothing
from services.kit.node import Node
from services.kit.settings import ServiceSettings
from services.recorder.service import RecorderService
from services.recordings.encoding import decode_image
from services.recordings.reader import Recording, read_recording
from services.recordings.stream import RecordingError
from services.recordings.writer import EpisodeWriter
from tests.services.recordings.recorded_messages import (
    applied,
    command,
    episode,
    event,
    frame,
    header,
    image,
    pixels,
    state,
)
from tests.services.recordings.test_recorder_files import leave, read_all, record


def read_messages(folder: Path, messages: list[Message]) -> Recording:
    return read_recording(record(folder, messages))


def test_recording_is_unchanged_when_read_back(tmp_path: Path) -> None:
    recording = read_messages(tmp_path, list(episode("drive-1", purpose="recovery")))
    (read,) = recording.episodes
    assert (recording.truncated, recording.bad) == (False, 0)
    place = (read.robot, read.episode, read.world, read.seed)
    assert place == ("rescuebot", "drive-1", "campus", 7)
    course = (read.purpose, read.driver, read.outcome, read.end_tick)
    assert course == ("recovery", "expert", "found", 4)
    assert sorted(read.poses) == list(range(5))
    assert read.poses[2].x_m == 3.0
    (piece,) = read.pieces()
    assert piece.tolist() == list(range(5))
    assert [read.is_goal(tick) for tick in range(5)] == [False] * 4 + [True]
    atoms = [read.atom(tick) for tick in range(5)]
    assert atoms == ["forward", "backward", "left", "right", "stop"]
    for tick in range(5):
        image = decode_image(bytes(read.images[tick]))
        assert np.abs(image.astype(int) - pixels(tick)).max() <= 4
        assert read.odometry[tick].pose == (1.5 * tick, 0.1, 0.02)


@pytest.mark.parametrize(
    ("lost", "ticks", "pieces"),
    [
        ("camera/jpeg", [2], [[0, 1], [3, 4]]),
        ("odometry", [2], [[0, 1], [3, 4]]),
        ("odometry", range(5), [[0, 1, 2, 3, 4]]),
    ],
)
def test_pieces_split_when_a_frame_lacks_image_or_odometry(
    tmp_path: Path, lost: str, ticks: list[int], pieces: list[list[int]]
) -> None:
    sent = [m for m in episode("e") if m.topic_name != lost or m.tick not in ticks]
    (read,) = read_messages(tmp_path, sent).episodes
    assert [piece.tolist() for piece in read.pieces()] == pieces


def test_no_piece_spans_a_gap(tmp_path: Path) -> None:
    lost = {("camera/jpeg", 3), ("command/applied", 6)}
    sent = [
        message
        for message in episode("e", frames=9)
        if (message.topic_name, message.tick) not in lost
    ]
    late = applied("e", 1, sequence=9, atom="right")
    (read,) = read_messages(tmp_path, [*sent, late]).episodes
    pieces = read.pieces()
    assert read.atom(1) == "right", "the last command of a tick moved the robot"
    assert [piece.tolist() for piece in pieces] == [[0, 1, 2], [4, 5], [7, 8]]
    assert [read.is_goal(piece[-1]) for piece in pieces] == [False, False, True]


def test_goal_is_the_last_frame_when_outcome_is_found(tmp_path: Path) -> None:
    whole = list(episode("e", frames=4))
    passed = [*whole[:-1], applied("e", 3), *frame("e", 4), event("e", 4, "ended", "aborted")]
    came_back = [*passed[:-1], event("e", 4, "ended", "found")]
    contradiction = [*whole[:-1], applied("e", 3), *frame("e", 4), whole[-1]]
    timeout = list(episode("e", frames=4, outcome="timeout"))
    goals = []
    for k, sent in enumerate((whole, passed, came_back, contradiction, timeout)):
        folder = tmp_path / str(k)
        folder.mkdir()
        (read,) = read_messages(folder, sent).episodes
        goals.append([(int(piece[-1]), read.is_goal(piece[-1])) for piece in read.pieces()])
    assert goals == [[(3, True)], [(3, False)], [(4, True)], [(3, False)], [(2, False)]]


def test_reader_loses_one_second_when_file_is_cut(tmp_path: Path) -> None:
    content = record(tmp_path, list(episode("e", frames=24))).read_bytes()
    cut = tmp_path / "cut.mcap"
    read = []
    complaints = set()
    # Every region is hit: magic, header, metadata, chunks, indexes, summary, footer.
    for size in sorted(
        {
            *range(0, 64, 3),
            *range(0, len(content), 4001),
            *range(len(content) - 64, len(content), 3),
        }
    ):
        cut.write_bytes(content[:size])
        try:
            recording = read_recording(cut)
        except RecordingError as error:
            complaints.add(str(error))
            continue
        assert (recording.truncated, recording.bad) == (True, 0)
        (only,) = recording.episodes
        for tick, payload in only.images.items():
            assert np.abs(decode_image(bytes(payload)).astype(int) - pixels(tick)).max() <= 4
        read.append(only.frames)
    assert complaints == {
        f"{cut}: {reason}"
        for reason in ("empty", "not an MCAP file", "no episode in this recording")
    }
    assert read == sorted(read)
    assert len(set(read)) == 3
    assert read[-1] == 24


def test_a_fifo_or_a_device_is_not_waited_for(tmp_path: Path) -> None:
    for name in ("fifo.mcap", "fifo.mcap.partial"):
        os.mkfifo(tmp_path / name)
        with pytest.raises(RecordingError, match=f"^{tmp_path / name}: Not a regular file$"):
            read_recording(tmp_path / name)
    (tmp_path / "zero.mcap").symlink_to("/dev/zero")
    with pytest.raises(RecordingError, match=r"Not a regular file$"):
        read_recording(tmp_path / "zero.mcap")


def test_a_living_recording_is_refused_and_a_dead_one_read(tmp_path: Path) -> None:
    writer = EpisodeWriter.begin(tmp_path, event("living", 0, "started"))
    with pytest.raises(RecordingError, match="still being recorded"):
        read_recording(tmp_path / "living.mcap.partial")
    writer.seal()
    recording = read_recording(leave(tmp_path, list(episode("dead"))))
    assert recording.truncated
    assert len(recording.episodes[0].images) == 5


def held_by(*files: str) -> int:
    """Return the bytes that were taken by files and are still held; those of other threads of this process are not."""
    gc.collect()
    taken = tracemalloc.take_snapshot().filter_traces(
        [tracemalloc.Filter(True, file) for file in files]
    )
    return sum(trace.size for trace in taken.traces)


def test_recorder_memory_is_constant_during_a_drive(
    settings: ServiceSettings, tmp_path: Path
) -> None:
    """The drive lasts two minutes with four messages a tick."""
    told = [
        image("e", 0),
        applied("e", 0, sequence=0),
        state("e", 0),
        command("e", 0, "teleop"),
    ]
    now_s = 0.0
    held = []
    ticks = 1200
    with Node("recorder", settings) as node:
        recorder = RecorderService(node, tmp_path, tmp_path, lambda: now_s)
        recorder.handle(event("e", 0, "started"))
        tracemalloc.start()
        try:
            for tick in range(ticks):
                now_s += TICK_S
                for message in told:
                    stamp_ns = header("e", tick).stamp_ns
                    recorder.handle(message.model_copy(update={"tick": tick, "stamp_ns": stamp_ns}))
                if tick % 10 == 9:
                    recorder.look_after_files()
                if tick in (ticks // 2 - 1, ticks - 1):
                    held.append(
                        held_by("*/services/recorder/*", "*/services/recordings/*", "*/mcap/*")
                    )
        finally:
            tracemalloc.stop()
        recorder.close()
    # Each of 60 seconds is one entry of the index; what the last second holds comes and goes.
    assert held[1] - held[0] < 60 * 400 + 50_000
    assert len(read_all(tmp_path / "e.mcap")) == 1 + 4 * ticks


def test_early_messages_are_bounded_and_counted(settings: ServiceSettings, tmp_path: Path) -> None:
    """Frames of the largest size arrive for an episode without a start."""
    with Node("recorder", settings) as node:
        recorder = RecorderService(node, tmp_path, tmp_path)
        largest = CompressedImage.after(
            header("e", 0), width=4096, height=3072, data=b"\xff\xd8" + bytes(15 << 20)
        )
        for tick in range(10):
            recorder.handle(largest.model_copy(update={"tick": tick}))
        recorder.handle(event("e", 0, "started"))
        reply = recorder.stop(Nothing())
        assert reply.dropped == 6, "four of 15 MiB in 64 MiB"
    assert len(read_all(tmp_path / reply.files[0])) == 1 + 4
