"""Small recordings that unpack to much: what reading them takes in memory is bounded in total."""

import struct
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, McapRecord, Message
from mcap.writer import CompressionType, Writer

from schemas.episode import Purpose
from schemas.topics import key_of
from services.recordings.contents import contents_of
from services.recordings.dataset import Teacher
from services.recordings.encoding import payload_of
from services.recordings.reader import read_recording
from services.recordings.records import MAGIC, Allowance
from services.recordings.replay import tracks_of
from services.recordings.stream import RecordingError
from smal.features import FeatureSettings
from tests.services.recordings.recorded_messages import episode, event
from tests.services.waiting import DEADLINE_S

MIB = 2**20
CHUNK_HEAD = struct.Struct("<BQQQQIIQ")  # Head of a chunk that is not packed.
ALLOWED = 128 * MIB
#: What reading may take beside what is allowed: the largest chunk while it is unpacked and checked, and the reader.
BESIDE = 160 * MIB
CHUNKS = 12
PADDING = 24 * MIB
#: What can be packed as well as a fair recording may be, a hundred times.
FAIR = np.random.default_rng(1).bytes(MIB // 2) * (PADDING // (MIB // 2))
_KEYS = {"episode": 1, "camera/jpeg": 2, "padding": 3, "pose/truth": 4}

_READ = """
import sys
from pathlib import Path
from services.recordings.dataset import Teacher
from services.recordings.records import Allowance
from smal.features import FeatureSettings

def peak():
    (line,) = [line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM")]
    return int(line.split()[1]) * 1024

teacher = Teacher(FeatureSettings(), 5)
teacher._allowance = Allowance(int(sys.argv[1]))
before = peak()
for path in sys.argv[2:]:
    teacher.read(Path(path))
print(peak() - before)
print(*teacher.teaching.remarks, sep=chr(10))
"""


def raw(*parts: McapRecord) -> bytes:
    builder = RecordBuilder()
    for part in parts:
        part.write(builder)
    return bytes(builder.end())


def channels(**more: str) -> bytes:
    metadata = {"robot": "rescuebot", "episode": "e"}
    return raw(
        *(
            Channel(number, f"smal/rescuebot/{key}", "json", metadata | more, 0)
            for key, number in _KEYS.items()
        )
    )


def message(key: str, tick: int, data: bytes) -> bytes:
    return raw(Message(_KEYS[key], tick, data, tick, tick))


def packed(data: bytes) -> bytes:
    return raw(Chunk("zstd", zstandard.compress(data), 0, 0, 0, len(data)))


def began() -> bytes:
    return channels() + message("episode", 0, event("e", 0, "started").model_dump_json().encode())


def write(path: Path, *chunks: bytes) -> Path:
    path.write_bytes(MAGIC + began() + b"".join(chunks))
    return path


def reading(*paths: Path) -> tuple[int, list[str]]:
    """Return by how much reading files as `smal learn` does raises the peak of memory, and what it remarks."""
    done = subprocess.run(
        [sys.executable, "-c", _READ, str(ALLOWED), *map(str, paths)],
        capture_output=True, text=True, timeout=DEADLINE_S, check=True,
    )  # fmt: skip
    peak, *remarks = done.stdout.splitlines()
    return int(peak), remarks


def images(path: Path) -> Path:
    """Write images, each with padding that its chunk keeps: 300 MB in 4 MB."""
    padding = message("padding", 0, FAIR)
    return write(
        path, *(packed(message("camera/jpeg", tick, b"x") + padding) for tick in range(CHUNKS))
    )


def poses(path: Path) -> Path:
    """Write a hundred thousand true poses, each of 100 bytes in a file, and of 1.2 kB in memory."""
    pose = '{"robot":"rescuebot","episode":"e","tick":%d,"stamp_ns":%d,"x_m":0,"y_m":0,"heading_rad":0}'
    stamps = np.random.default_rng(1).integers(10**9, size=100_000).tolist()
    told = [
        message("pose/truth", tick, (pose % (tick, stamp_ns)).encode())
        for tick, stamp_ns in enumerate(stamps)
    ]
    return write(
        path, *(packed(b"".join(told[at : at + 25_000])) for at in range(0, len(told), 25_000))
    )


@pytest.mark.parametrize("make", [images, poses])
def test_reading_takes_bounded_memory(tmp_path: Path, make: Callable[[Path], Path]) -> None:
    path = make(tmp_path / "bomb.mcap")
    peak, remarks = reading(path)
    assert peak < ALLOWED + BESIDE
    why = "too large: more than 0.125 GiB of memory, including earlier recordings; unpack it first (mcap decompress), "
    assert remarks[0] == f"{path}: {why}or read fewer at once"


def test_recordings_share_one_memory_limit(tmp_path: Path) -> None:
    """Each recording alone is within the limit."""
    teacher = Teacher(FeatureSettings(), 5)
    teacher._allowance = Allowance(ALLOWED)
    for number in range(3):
        teacher.read(drive(tmp_path / f"r{number}.mcap", f"r{number}", FAIR, "run"))
    drives = [drive(tmp_path / f"{k}.mcap", f"e{k}", FAIR) for k in range(8)]
    for path in (*drives, drive(tmp_path / "small.mcap", "small")):
        teacher.read(path)
    too_much = [remark for remark in teacher.teaching.remarks if "more than 0.125 GiB" in remark]
    assert len(too_much) == 8 - ALLOWED // PADDING
    assert len(teacher.teaching.demonstrations) == ALLOWED // PADDING + 1


def drive(path: Path, name: str, padding: bytes = b"", purpose: Purpose = "drive") -> Path:
    """Write a drive as one packed chunk, with padding."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=2 * PADDING, compression=CompressionType.ZSTD)
        writer.start(profile="", library="")
        schema = writer.register_schema("any", "jsonschema", b"{}")
        metadata = {"robot": "rescuebot", "episode": name}
        numbers: dict[str, int] = {}
        for one in episode(name, frames=8, purpose=purpose):
            key = key_of(one)
            if key not in numbers:
                numbers[key] = writer.register_channel(key, "json", schema, metadata)
            writer.add_message(numbers[key], one.stamp_ns, payload_of(one), one.stamp_ns, one.tick)
        number = writer.register_channel("padding", "none", schema, {})
        writer.add_message(number, 0, padding, 0, 0)
        writer.finish()
    return path


def test_reader_skips_index_and_parses_small_parts(tmp_path: Path) -> None:
    entries = struct.pack("<QQ", 1, 1) * (2 * MIB)
    index = struct.pack("<BQHI", Opcode.MESSAGE_INDEX, len(entries) + 6, 1, len(entries)) + entries
    numbers = bytes(10) * (3 * MIB)
    statistics = struct.pack("<BQ", Opcode.STATISTICS, len(numbers)) + numbers
    beyond = struct.pack("<BQ", Opcode.CHUNK_INDEX, 2**62)
    path = write(tmp_path / "index.mcap", index, statistics, beyond)
    peak, remarks = reading(path)
    assert peak < BESIDE
    assert remarks == [f"{path}: no camera frame in this recording"]
    pairs = {f"{number:0>100}": "" for number in range(MIB // 6)}
    channel = raw(Channel(1, "smal/rescuebot/episode", "json", pairs, 0))
    path = write(tmp_path / "map.mcap", channel)
    peak, remarks = reading(path)
    assert peak < BESIDE
    assert remarks == [
        f"{path}: damaged: record too large ({len(channel) - 9} bytes > maximum {16 * MIB}); see smal recording repair"
    ]


def test_a_chunk_is_not_unpacked_that_says_that_it_is_large(tmp_path: Path) -> None:
    for size in (64 * MIB + 1, 2**63):
        lie = raw(Chunk("zstd", zstandard.compress(b"x"), 0, 0, 0, size))
        with pytest.raises(RecordingError, match=f"bytes > maximum {64 * MIB}"):
            read_recording(write(tmp_path / "lie.mcap", lie))


NO_RECORDS = [
    (bytes(64 * MIB), r"unpacks to more than 256 times its size|a record of kind 0"),
    (bytes(9) * 4, r"damaged: a record of kind 0 in a chunk; see"),
    (raw(DataEnd(0)) + bytes(20), r"damaged: a record of kind 15 in a chunk; see"),
    (raw(Message(9, 0, b"", 0, 0)) * 4000, r"one for less than 4 bytes"),
]


@pytest.mark.parametrize(
    ("content", "why"), NO_RECORDS, ids=["zeros", "unknown kind", "misplaced", "too many"]
)
@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_bomb_is_rejected_fast_when_unpacked(
    tmp_path: Path, content: bytes, why: str, compression: str
) -> None:
    """A file of 2 kB once took 13 s of processor time, a file of 1 MB took 4 GiB."""
    pack = zstandard.compress if compression == "zstd" else lz4.frame.compress
    path = write(
        tmp_path / "bomb.mcap", raw(Chunk(compression, pack(content), 0, 0, 0, len(content)))
    )
    began_s = time.process_time()
    for read in (read_recording, contents_of, tracks_of):
        with (
            pytest.raises(RecordingError, match=why)
            if read is read_recording
            else suppress(RecordingError)
        ):
            read(path)
    assert time.process_time() - began_s < 3.0


def test_recovery_ends_when_every_byte_resembles_a_chunk(tmp_path: Path) -> None:
    """1 MB once took 19 s of processor time, and four times as long at each doubling."""
    heads = bytearray(MAGIC + b"\xff" + bytes(20))
    head = CHUNK_HEAD.size
    behind = 2 * MIB
    while len(heads) + head < behind:
        room = behind - len(heads) - head
        heads += CHUNK_HEAD.pack(Opcode.CHUNK, head + room - 9, 0, 0, room, 0x12345678, 0, room)
    (path := tmp_path / "heads.mcap").write_bytes(heads)
    began_s = time.process_time()
    assert contents_of(path).findings
    assert time.process_time() - began_s < 3.0
