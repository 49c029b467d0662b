"""What the recorder holds in memory is bounded, however long an episode is and whatever comes."""

import gc
import tracemalloc
from pathlib import Path

from schemas.camera import CompressedImage
from schemas.rpc import Nothing
from services.kit.node import Node
from services.kit.settings import ServiceSettings
from services.recorder.service import RecorderService
from services.robot.clock import TICK_S
from tests.services.recordings.recorded_messages import applied, command, event, header, image, observation
from tests.services.recordings.test_recorder_files import read_all


def held_by(*files: str) -> int:
    """Return the bytes that were taken by files and are still held; those of other threads of this process are not."""
    gc.collect()
    taken = tracemalloc.take_snapshot().filter_traces([tracemalloc.Filter(True, file) for file in files])
    return sum(trace.size for trace in taken.traces)


def test_what_the_recorder_and_its_writer_hold_does_not_grow_with_the_drive(
    settings: ServiceSettings, tmp_path: Path
) -> None:
    """With a clock that runs as the drive does: two minutes of four messages a tick, looked after each second."""
    told = [image("e", 0), applied("e", 0, sequence=0), observation("e", 0), command("e", 0, "teleop")]
    now_s, held, ticks = 0.0, [], 1200
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
                    held.append(held_by("*/services/recorder/*", "*/services/recordings/*", "*/mcap/*"))
        finally:
            tracemalloc.stop()
        recorder.close()
    # Each of 60 seconds is one entry of the index; what the last second holds comes and goes.
    assert held[1] - held[0] < 60 * 400 + 50_000
    assert len(read_all(tmp_path / "e.mcap")) == 1 + 4 * ticks


def test_what_waits_for_its_episode_is_bounded_and_counted(settings: ServiceSettings, tmp_path: Path) -> None:
    """Frames of an episode that nobody began, as large as they may be; of those that fit none is lost."""
    with Node("recorder", settings) as node:
        recorder = RecorderService(node, tmp_path, tmp_path)
        largest = CompressedImage.after(header("e", 0), width=4096, height=3072, data=b"\xff\xd8" + bytes(15 << 20))
        for tick in range(10):
            recorder.handle(largest.model_copy(update={"tick": tick}))
        recorder.handle(event("e", 0, "started"))
        reply = recorder.stop(Nothing())
        assert reply.dropped == 6, "four of 15 MiB in 64 MiB"
    assert len(read_all(tmp_path / reply.files[0])) == 1 + 4
