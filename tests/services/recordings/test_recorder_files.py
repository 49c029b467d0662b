"""What the recorder writes: readable by everyone, complete, and never lost."""

import errno
import itertools
import json
import os
import tracemalloc
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel
from mcap.records import Message as StoredMessage
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from schemas.base import Message
from schemas.camera import CompressedImage
from schemas.topics import TOPICS, topic_of
from services.recordings.encoding import payload_of, plain_json_schema
from services.recordings.ledger import Ledger
from services.recordings.leftover import LeftoverError, seal_leftover
from services.recordings.records import MAGIC, heads
from services.recordings.sink import Sink, partial_of
from services.recordings.views import is_view
from services.recordings.writer import GAPS_METADATA, EpisodeWriter
from tests.benchmarks.faults.recordings import ticks_of
from tests.services.recordings.recorded_messages import (
    applied,
    command,
    episode,
    event,
    frame,
    header,
    image,
    state,
)


def record(folder: Path, messages: list[Message]) -> Path:
    writer = EpisodeWriter.begin(folder, messages[0])
    for message in messages:
        writer.write(message)
    path = writer.seal()
    assert writer.problem is None
    return path


def stored_in(path: Path, **options: Any) -> list[tuple[Channel, StoredMessage]]:
    """Read what was recorded; what is derived for viewers is left out."""
    with path.open("rb") as file:
        found = make_reader(file).iter_messages(**options)
        return [(channel, message) for _, channel, message in found if not is_view(channel.topic)]


def read_all(path: Path) -> list[tuple[str, int, bytes]]:
    return [(channel.topic, message.sequence, message.data) for channel, message in stored_in(path)]


def metadata(path: Path) -> dict[str, dict[str, str]]:
    with path.open("rb") as file:
        return {record.name: record.metadata for record in make_reader(file).iter_metadata()}


def test_every_message_comes_back_as_it_was(tmp_path: Path) -> None:
    sent = list(episode("drive-1"))
    path = record(tmp_path, sent)
    found = stored_in(path, log_time_order=False)
    assert len(found) == len(sent)
    for message, (channel, stored) in zip(sent, found, strict=True):
        assert channel.topic == TOPICS[message.topic_name].key("rescuebot")
        assert channel.metadata == {"robot": "rescuebot", "episode": "drive-1"}
        assert (stored.log_time, stored.sequence) == (message.stamp_ns, message.tick)
        if not isinstance(message, CompressedImage):
            assert type(message).model_validate_json(stored.data) == message
    assert {topic_of(channel.topic) for channel, _ in found} == {
        t for t in TOPICS.values() if t.recorded
    }
    late = [stored.sequence for _, stored in stored_in(path, starting_at=header("e", 3).stamp_ns)]
    assert late == [message.tick for message in sent if message.tick >= 3], "a viewer finds its way"


@pytest.mark.parametrize(
    "topic", [t for t in TOPICS.values() if t.message is not CompressedImage], ids=lambda t: t.name
)
def test_json_schemas_are_of_the_kind_that_foxglove_reads(topic: Any) -> None:
    def check(schema: dict[str, Any]) -> None:
        assert schema["type"] in ("boolean", "string", "number", "integer", "object", "array")
        for child in schema.get("properties", {}).values():
            check(child)
        if schema["type"] == "array":
            check(schema["items"])

    schema = plain_json_schema(topic.message)
    check(schema)
    assert "$ref" not in json.dumps(schema)


def test_writer_drops_duplicates_and_reports_missing_ticks(tmp_path: Path) -> None:
    again = [
        *frame("e", 0),
        *frame("e", 0),
        applied("e", 0),
        command("e", 0, sequence=1),
        applied("e", 0),
    ]
    path = record(
        tmp_path, [event("e", 0, "started"), *again, event("e", 0, "victim_found"), *frame("e", 1)]
    )
    assert len(read_all(path)) == 2 + 2 * len(frame("e", 0)) + 2
    assert metadata(path)[GAPS_METADATA]["duplicates"] == str(len(frame("e", 0)) + 1)
    sent = [event("e", 0, "started"), *(image("e", tick) for tick in (0, 1, 4, 6))]
    path = record(
        tmp_path,
        [
            *sent,
            *(state("e", tick) for tick in range(1, 8)),
            event("e", 7, "ended", "aborted"),
        ],
    )
    assert metadata(path)[GAPS_METADATA] == {
        "duplicates": "0",
        "camera/jpeg": "2-3 5 7",
        "state": "0",
    }


@given(
    st.lists(
        st.tuples(st.sampled_from(["pose/truth", "state", "command/applied"]), st.integers(0, 12))
    )
)
def test_ledger_lists_missing_messages_in_any_order(
    sent: list[tuple[str, int]],
) -> None:
    ledger = Ledger()
    seen: set[tuple[str, int]] = set()
    for topic, tick in sent:
        message = {
            "pose/truth": frame("e", tick)[0],
            "state": state("e", tick),
            "command/applied": applied("e", tick),
        }[topic]
        assert ledger.admit(message) == ((topic, tick) not in seen)
        seen.add((topic, tick))
    ledger.close(12)
    missing = {}
    for topic in {topic for topic, _ in seen}:
        ticks = {tick for name, tick in seen if name == topic}
        last = 12 if topic == "pose/truth" else max(ticks)
        missing[topic] = set(range(last + 1)) - ticks
    assert ledger.duplicates == len(sent) - len(seen)
    assert ledger.gap_ticks == sum(map(len, missing.values()))
    assert ledger.missing == {topic: len(ticks) for topic, ticks in missing.items() if ticks}
    named = {topic: ticks_of(text) for topic, text in ledger.gaps().items()}
    assert named == {topic: ticks for topic, ticks in missing.items() if ticks}
    assert ledger.whole(12) == (not ledger.gap_ticks)


def test_ledger_is_bounded_when_messages_flood_a_tick() -> None:
    """A stolen key of the policy once filled 460 MB."""
    ledger = Ledger()
    one = command("e", 5, "policy")
    tracemalloc.start()
    for place in range(30_000):
        ledger.admit(one.model_copy(update={"sequence": place}))
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held < 8e6
    assert ledger.admit(command("e", 6, "policy"))


def test_no_recording_is_overwritten(tmp_path: Path) -> None:
    first, second = (record(tmp_path, list(episode("drive-1", frames=n))) for n in (2, 3))
    assert [first.name, second.name] == ["drive-1.mcap", "drive-1-2.mcap"]
    partial = leave(tmp_path, list(episode("e")))
    (tmp_path / "e.mcap").write_bytes(b"another")
    assert seal_leftover(partial).path == tmp_path / "e-2.mcap"
    assert (tmp_path / "e.mcap").read_bytes() == b"another"


def leave(folder: Path, messages: list[Message]) -> Path:
    """Record, and leave the file as the system has it after a kill, a second after the last message."""
    writer = EpisodeWriter.begin(folder, messages[0])
    for message in messages:
        writer.write(message)
    writer.flush()
    writer._sink.close()
    return partial_of(writer.path)


def wanted(messages: list[Message]) -> list[tuple[str, int, bytes]]:
    return sorted((TOPICS[m.topic_name].key("rescuebot"), m.tick, payload_of(m)) for m in messages)


def check(path: Path) -> None:
    """Read everything, with all checksums."""
    with path.open("rb") as file:
        list(StreamReader(file, validate_crcs=True).records)


def exits_at(step: int) -> None:
    """Have this process end, as by a kill, before the given change of a file or a folder."""
    steps = itertools.count()

    def counted(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            if next(steps) == step:
                os._exit(9)
            return function(*arguments, **options)

        return call

    for name in ("write", "ftruncate"):
        setattr(os, name, counted(getattr(os, name)))
    for name in ("rename", "unlink"):
        setattr(Path, name, counted(getattr(Path, name)))


def test_written_messages_survive_when_recorder_is_killed(tmp_path: Path) -> None:
    sent = [
        message
        for message in episode("e", frames=33)
        if message.topic_name in ("episode", "camera/jpeg")
    ]
    tell = os.write
    killed = True
    step = 0
    while killed:
        folder = tmp_path / str(step)
        folder.mkdir()
        told, teller = os.pipe()
        if os.fork() == 0:
            exits_at(step)
            writer = EpisodeWriter.begin(folder, sent[0])
            for message in sent:
                writer.write(message)
                tell(teller, bytes([writer.messages - writer.waiting]))
            writer.seal()
            os._exit(0)
        os.close(teller)
        killed = os.waitstatus_to_exitcode(os.wait()[1]) == 9
        with os.fdopen(told, "rb") as written:
            count = max(written.read(), default=0)
        for partial in folder.glob("*.partial"):
            _seal_killed_at(partial, step % 4)
        for path in folder.iterdir():
            check(path)
            stored = read_all(path)
            assert sorted(stored) == wanted(sent[: len(stored)])
            assert len(stored) >= count
        assert count == 0 or len(list(folder.iterdir())) == 1
        step += 1
    assert step > 10


def _seal_killed_at(partial: Path, step: int) -> None:
    """Seal what was left, in a process that is killed in doing so, and then in one that is not."""
    if os.fork() == 0:
        exits_at(step)
        with suppress(LeftoverError):
            seal_leftover(partial)
        os._exit(0)
    os.wait()
    with suppress(LeftoverError, FileNotFoundError):
        seal_leftover(partial)
    partial.unlink(missing_ok=True)  # it holds no message


def test_sealing_skips_open_and_foreign_files(tmp_path: Path) -> None:
    living = EpisodeWriter.begin(tmp_path, event("living", 0, "started"))
    foreign = tmp_path / "foreign.mcap.partial"
    foreign.write_bytes(b"holiday pictures, not to be touched")
    other = tmp_path / "other.mcap.partial"
    with other.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("else", "json", 0)
        for number in range(3):
            writer.add_message(channel, number, b"{}", number)
        writer.finish()
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    for path in (foreign, other):
        with pytest.raises(LeftoverError, match="not the recording of an episode"):
            seal_leftover(path)
    with pytest.raises(BlockingIOError):
        seal_leftover(partial_of(living.path))
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
    living.write(image("living", 0))
    assert read_all(living.seal())


def test_leftover_is_kept_for_repair_when_damaged(
    tmp_path: Path,
) -> None:
    partial = leave(tmp_path, list(episode("e", frames=35)))
    content = bytearray(partial.read_bytes())
    _, second, *_ = [
        head.begin for head in heads(memoryview(content), len(MAGIC)) if head.opcode == Opcode.CHUNK
    ]
    content[second - 6] ^= 0xFF  # its length
    partial.write_bytes(content)
    with pytest.raises(
        LeftoverError, match=f"^damaged at byte {second - 9}; see smal recording repair$"
    ):
        seal_leftover(partial)
    assert partial.read_bytes() == content


class FullDisk(Sink):
    """A disk with room for ``room`` bytes; half of the write that does not fit is written."""

    room = 150_000

    def write(self, data: bytes) -> None:
        if self.tell() + len(data) > self.room:
            os.write(self._descriptor, data[: max(0, self.room - self.tell())])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        super().write(data)


def test_a_full_disk_is_told_how_many_messages_it_cost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    messages = list(episode("full", frames=25))
    whole = memoryview(leave(tmp_path, messages).read_bytes())
    end = next(head.end for head in heads(whole, len(MAGIC)) if head.opcode == Opcode.CHUNK)
    monkeypatch.setattr("services.recordings.writer.Sink", FullDisk)
    for room in (end - 1, end, end + 50):
        monkeypatch.setattr(FullDisk, "room", room)
        writer = EpisodeWriter.begin(tmp_path, messages[0])
        with pytest.raises(OSError, match="No space left"):
            list(map(writer.write, messages))
        sealed = seal_leftover(writer.seal()).path
        kept = len(read_all(sealed)) if sealed else 0
        assert kept + writer.waiting == writer.messages
        assert bool(kept) == (room >= end)
