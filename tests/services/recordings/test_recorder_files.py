"""What the recorder writes: readable by everyone, complete, and never lost."""

from __future__ import annotations

import errno
import itertools
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Channel
from mcap.records import Message as StoredMessage
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from schemas.base import Message
from schemas.compressed_image import CompressedImage
from schemas.topics import TOPICS, topic_of
from services.recordings import writer as mcap_writer
from services.recordings.encoding import decode_image, payload_of, plain_json_schema
from services.recordings.ledger import Ledger, order_of
from services.recordings.reader import read_recording
from services.recordings.sink import Sink, partial_of
from services.recordings.views import is_view
from services.recordings.writer import EPISODE_METADATA, GAPS_METADATA, EpisodeWriter, RecoveryError
from tests.benchmarks.faults.recordings import ticks_of
from tests.services.recordings.recorded_messages import (
    FINGERPRINT,
    applied,
    command,
    episode,
    event,
    frame,
    header,
    image,
    observation,
    pixels,
)


def write_all(writer: EpisodeWriter, messages: list[Message]) -> None:
    for message in messages:
        writer.write(message)


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
    assert {topic_of(channel.topic) for channel, _ in found} == {t for t in TOPICS.values() if t.recorded}


def test_images_are_compressed_images_of_the_same_pixels(tmp_path: Path) -> None:
    path = record(tmp_path, [event("drive-1", 0, "started"), image("drive-1", 0)])
    with path.open("rb") as file:
        ((schema, channel, stored),) = make_reader(file).iter_messages(topics=["smal/rescuebot/camera/jpeg"])
    assert (schema.name, schema.encoding) == ("foxglove.CompressedImage", "protobuf")
    assert channel.message_encoding == "protobuf"
    # As a viewer does: nothing but the file's own descriptors.
    pool = DescriptorPool()
    for descriptor in FileDescriptorSet.FromString(schema.data).file:
        pool.Add(descriptor)
    packed = GetMessageClass(pool.FindMessageTypeByName(schema.name)).FromString(stored.data)
    assert packed.format == "jpeg"
    assert packed.timestamp.seconds * 10**9 + packed.timestamp.nanos == image("drive-1", 0).stamp_ns
    difference = decode_image(stored.data).astype(int) - pixels(0)
    assert np.abs(difference).max() <= 4


def test_summary_lists_schemas_channels_and_statistics(tmp_path: Path) -> None:
    sent = list(episode("drive-1"))
    path = record(tmp_path, sent)
    with path.open("rb") as file:
        summary = make_reader(file, validate_crcs=True).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    recorded = [topic for topic in TOPICS.values() if topic.recorded]
    own = {number for number, channel in summary.channels.items() if not is_view(channel.topic)}
    assert len(own) == len(recorded)
    assert {summary.schemas[summary.channels[number].schema_id].name for number in own} == {
        "foxglove.CompressedImage" if t.message is CompressedImage else t.message.schema_name() for t in recorded
    }
    counts = summary.statistics.channel_message_counts
    assert summary.statistics.message_count == sum(counts.values())
    assert sum(count for number, count in counts.items() if number in own) == len(sent)
    assert summary.statistics.message_start_time == sent[0].stamp_ns
    assert summary.statistics.message_end_time == sent[-1].stamp_ns
    # The index lets a viewer seek, however big the file is; the driven way as a whole is the last chunk.
    assert len(summary.chunk_indexes) == len(sent) + 1
    third = [message for _, message in stored_in(path, starting_at=header("e", 3).stamp_ns)]
    assert [message.sequence for message in third] == [message.tick for message in sent if message.tick >= 3]
    assert [index.name for index in summary.metadata_indexes] == [EPISODE_METADATA, GAPS_METADATA]


def test_metadata_says_what_the_episode_is(tmp_path: Path) -> None:
    found = metadata(record(tmp_path, list(episode("drive-1"))))
    said = found[EPISODE_METADATA]
    assert said["software"]
    assert {key: said[key] for key in ("robot", "episode", "world", "seed", "purpose", "driver")} == {
        "robot": "rescuebot",
        "episode": "drive-1",
        "world": "campus",
        "seed": "7",
        "purpose": "drive",
        "driver": "expert",
    }
    assert found[GAPS_METADATA] == {"duplicates": "0"}


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


def test_what_is_sent_again_is_written_once(tmp_path: Path) -> None:
    again = [
        *frame("e", 0),
        *frame("e", 0),
        applied("e", 0),
        command("e", 0, sequence=1),
        applied("e", 0),
        *frame("e", 1),
    ]
    path = record(tmp_path, [event("e", 0, "started"), *again])
    assert len(read_all(path)) == 1 + 2 * len(frame("e", 0)) + 2
    assert metadata(path)[GAPS_METADATA]["duplicates"] == str(len(frame("e", 0)) + 1)


def test_missing_ticks_are_named_in_the_file(tmp_path: Path) -> None:
    sent = [event("e", 0, "started")]
    sent += [image("e", tick) for tick in (0, 1, 4, 6)] + [observation("e", tick) for tick in (1, 2, 3, 4, 5, 6, 7)]
    path = record(tmp_path, [*sent, event("e", 7, "ended", "aborted")])
    gaps = metadata(path)[GAPS_METADATA]
    assert gaps == {"duplicates": "0", "camera/jpeg": "2-3 5 7", "observation": "0"}


def test_ledger_knows_every_order() -> None:
    ledger = Ledger()
    assert [
        ledger.admit("episode", order_of(m))
        for m in (event("e", 3, "started"), event("e", 3, "collision"), event("e", 3, "ended", "collision"))
    ] == [True] * 3
    assert not ledger.admit("episode", order_of(event("e", 3, "started")))
    assert ledger.duplicates == 1


@given(st.lists(st.tuples(st.sampled_from(["pose/truth", "observation", "command/applied"]), st.integers(0, 12))))
def test_the_ledger_misses_what_never_came_in_whatever_order_the_rest_did(sent: list[tuple[str, int]]) -> None:
    ledger = Ledger()
    seen: set[tuple[str, int]] = set()
    for topic, tick in sent:
        message = {
            "pose/truth": frame("e", tick)[0],
            "observation": observation("e", tick),
            "command/applied": applied("e", tick),
        }[topic]
        assert ledger.admit(topic, order_of(message)) == ((topic, tick) not in seen)
        seen.add((topic, tick))
    ledger.close(12)
    missing = {}
    for topic in {topic for topic, _ in seen}:
        ticks = {tick for name, tick in seen if name == topic}
        last = max(ticks) if topic == "command/applied" else 12
        missing[topic] = set(range(last + 1)) - ticks
    assert ledger.duplicates == len(sent) - len(seen)
    assert ledger.gap_ticks == sum(map(len, missing.values()))
    named = {topic: ticks_of(text) for topic, text in ledger.gaps().items()}
    assert named == {topic: ticks for topic, ticks in missing.items() if ticks}
    assert ledger.whole(12) == (not ledger.gap_ticks)


def test_no_recording_is_overwritten(tmp_path: Path) -> None:
    first, second = (record(tmp_path, list(episode("drive-1", frames=n))) for n in (2, 3))
    assert [first.name, second.name] == ["drive-1.mcap", "drive-1-2.mcap"]
    assert len(read_all(first)) == len(list(episode("drive-1", frames=2)))


def die(writer: EpisodeWriter) -> None:
    """Leave the files as the system has them after a kill, and give up the locks."""
    writer._sink.close()
    if writer._first is not None:
        os.close(writer._first[1])


def leave(folder: Path, messages: list[Message]) -> Path:
    """Record and die."""
    writer = EpisodeWriter.begin(folder, messages[0])
    write_all(writer, messages)
    die(writer)
    return partial_of(writer.path)


def leave_part(partial: Path, messages: list[Message]) -> None:
    """Go on recording and die."""
    writer = EpisodeWriter.resume(partial)
    write_all(writer, messages)
    die(writer)


def go_on(partial: Path, messages: list[Message]) -> Path:
    """Go on recording to the end."""
    writer = EpisodeWriter.resume(partial)
    write_all(writer, messages)
    path = writer.seal()
    assert writer.problem is None
    return path


def wanted(messages: list[Message]) -> list[tuple[str, int, bytes]]:
    return sorted((TOPICS[m.topic_name].key("rescuebot"), m.tick, payload_of(m)) for m in messages)


def check(path: Path) -> None:
    """Read everything, with all checksums."""
    with path.open("rb") as file:
        list(StreamReader(file, validate_crcs=True).records)


def test_leftovers_are_recovered_whole(tmp_path: Path) -> None:
    sent = list(episode("drive-1"))
    (tmp_path / "whole").mkdir()
    reference = record(tmp_path / "whole", sent)
    path = go_on(leave(tmp_path, sent), [])
    assert path == tmp_path / "drive-1.mcap"
    assert read_all(path) == read_all(reference)
    assert not list(tmp_path.glob("*.partial*"))
    with path.open("rb") as one, reference.open("rb") as other:
        left, right = make_reader(one).get_summary(), make_reader(other).get_summary()
    assert left is not None
    assert right is not None
    assert (left.schemas, left.channels) == (right.schemas, right.channels)
    assert left.statistics is not None
    assert right.statistics is not None
    assert left.statistics.channel_message_counts == right.statistics.channel_message_counts
    assert {**metadata(path)[EPISODE_METADATA], "recorded_utc": ""} == {
        **metadata(reference)[EPISODE_METADATA],
        "recorded_utc": "",
    }


def test_leftovers_cut_anywhere_are_recovered_as_far_as_they_are_whole(tmp_path: Path) -> None:
    sent = list(episode("e", frames=2))
    partial = leave(tmp_path, sent)
    content = partial.read_bytes()
    counts = []
    for size in (0, 5, 8):
        partial.write_bytes(content[:size])
        with pytest.raises(RecoveryError, match="it was empty and is removed"):
            EpisodeWriter.resume(partial)
        assert not partial.exists()
    for size in (9, 50, 100):
        partial.write_bytes(content[:size])
        with pytest.raises(RecoveryError, match="it is not the recording of an episode"):
            EpisodeWriter.resume(partial)
        assert partial.read_bytes() == content[:size]
    for size in (*range(500, len(content), 997), len(content)):
        partial.write_bytes(content[:size] + (b"\0" * 100 if size % 2 else b""))
        path = go_on(partial, [])
        check(path)
        counts.append(len(read_all(path)))
        path.unlink()
    assert counts == sorted(counts)
    assert counts[-1] == len(sent)


def test_a_leftover_is_gone_on_with_as_if_nothing_had_happened(tmp_path: Path) -> None:
    sent = [*episode("e", frames=6)]
    (tmp_path / "whole").mkdir()
    reference = record(tmp_path / "whole", sent)
    for kept in range(1, len(sent) + 1, 7):
        path = go_on(leave(tmp_path, sent[:kept]), sent[max(0, kept - 20) :])
        assert read_all(path) == read_all(reference)
        check(path)
        assert set(metadata(path)[GAPS_METADATA]) == {"duplicates"}
        path.unlink()


def test_the_parts_that_kills_left_are_read_as_one_recording_and_become_one(tmp_path: Path) -> None:
    sent = list(episode("e", frames=30))
    partial = leave(tmp_path, sent[:50])
    for kill in range(1, 11):
        leave_part(partial, sent[max(0, 40 * kill - 10) : 50 + 40 * kill])
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"e.mcap.partial"} | {f"e.mcap.partial-{number}" for number in range(2, 12)}
    (read,) = read_recording(partial, FINGERPRINT).episodes
    assert sorted(read.features) == sorted(read.images) == list(range(30))
    path = go_on(partial, sent[400:])
    assert list(tmp_path.iterdir()) == [path]
    (tmp_path / "whole").mkdir()
    assert read_all(path) == read_all(record(tmp_path / "whole", sent))
    ticks = [message.sequence for _, message in stored_in(path, log_time_order=False)]
    assert ticks == sorted(ticks)


def test_a_leftover_cut_anywhere_gets_what_it_lacks_when_that_is_sent_again(tmp_path: Path) -> None:
    """After a power failure zeros stand in place of the end, of the last record too."""
    sent = list(episode("e", frames=2))
    partial = leave(tmp_path, sent)
    content = partial.read_bytes()
    for size in range(700, len(content), 997):
        for zeros in (0, size % 3, 20_000, len(content) - size):
            partial.write_bytes(content[:size] + b"\0" * zeros)
            path = go_on(partial, sent)
            assert sorted(read_all(path)) == wanted(sent)
            path.unlink()


def test_ticks_that_nobody_can_send_any_more_are_named_after_a_resumption(tmp_path: Path) -> None:
    before = [event("e", 0, "started"), *frame("e", 0), applied("e", 0)]
    path = go_on(leave(tmp_path, before), [*frame("e", 4), event("e", 4, "ended", "aborted")])
    gaps = metadata(path)[GAPS_METADATA]
    assert gaps == {"duplicates": "0"} | dict.fromkeys(("camera/jpeg", "pose/truth", "observation", "state"), "1-3")


def exits_at(step: int) -> None:
    """Have this process end, as by a kill, before the given change of a file or a folder."""
    steps = itertools.count()

    def counted(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            if next(steps) == step:
                os._exit(9)
            return function(*arguments, **options)

        return call

    for name in ("write", "fsync"):
        setattr(os, name, counted(getattr(os, name)))
    for name in ("rename", "unlink"):
        setattr(Path, name, counted(getattr(Path, name)))


def test_a_kill_at_any_moment_of_the_merge_loses_nothing(tmp_path: Path) -> None:
    topics = ("episode", "observation", "pose/truth", "command/applied")
    sent = [message for message in episode("e", frames=2) if message.topic_name in topics]
    left = tmp_path / "left"
    left.mkdir()
    leave_part(leave(left, sent[:4]), sent[2:])
    killed = True
    step = 0
    while killed:
        folder = tmp_path / str(step)
        shutil.copytree(left, folder)
        child = os.fork()
        if child == 0:
            exits_at(step)
            EpisodeWriter.resume(folder / "e.mcap.partial").seal()
            os._exit(0)
        killed = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9
        path, partial = folder / "e.mcap", folder / "e.mcap.partial"
        assert path.exists() != partial.exists()
        (read,) = read_recording(path if path.exists() else partial, FINGERPRINT).episodes
        assert (sorted(read.features), sorted(read.poses), read.outcome) == ([0, 1], [0, 1], "found")
        if partial.exists():
            go_on(partial, [])
        assert sorted(read_all(path)) == wanted(sent)
        assert list(folder.iterdir()) == [path]
        step += 1
    assert step > 2 * len(sent)


def test_a_disk_that_fills_during_the_merge_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sent = list(episode("e", frames=2))
    partial = leave(tmp_path, sent[:10])
    leave_part(partial, sent[5:])
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    monkeypatch.setattr(mcap_writer, "Sink", FullDisk)
    for room in range(600, sum(map(len, before.values())), 1009):
        monkeypatch.setattr(FullDisk, "room", room)
        writer = EpisodeWriter.resume(partial)
        assert writer.seal() == partial
        assert writer.problem == "No space left on device"
        assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
    monkeypatch.undo()
    assert sorted(read_all(go_on(partial, []))) == wanted(sent)


def test_what_is_being_recorded_or_foreign_is_let_be(tmp_path: Path) -> None:
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
        with pytest.raises(RecoveryError, match="it is not the recording of an episode"):
            EpisodeWriter.resume(path)
    with pytest.raises(BlockingIOError):
        EpisodeWriter.resume(partial_of(living.path))
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
    living.write(image("living", 0))
    assert read_all(living.seal())


def test_a_damaged_message_becomes_a_gap_and_a_recording_damaged_otherwise_is_left_as_it_is(tmp_path: Path) -> None:
    partial = leave(tmp_path, list(episode("e")))
    content = partial.read_bytes()
    partial.write_bytes(content.replace(b'"x_m":3.0', b'"x_m":4.0'))
    path = go_on(partial, [])
    assert metadata(path)[GAPS_METADATA]["pose/truth"] == "2"
    path.unlink()
    partial.write_bytes(damaged := content.replace(b"smal/rescuebot/pose/truth", b"smal/rescuebot/pose/lies!"))
    writer = EpisodeWriter.resume(partial)
    assert writer.seal() == partial
    assert writer.problem == "e.mcap.partial is not the recording of an episode"
    assert [(path, path.read_bytes()) for path in tmp_path.iterdir()] == [(partial, damaged)]


def test_a_leftover_does_not_take_the_name_of_a_recording(tmp_path: Path) -> None:
    partial = leave(tmp_path, list(episode("e")))
    (tmp_path / "e.mcap").write_bytes(b"another")
    assert go_on(partial, []) == tmp_path / "e-2.mcap"
    assert (tmp_path / "e.mcap").read_bytes() == b"another"


class FullDisk(Sink):
    """A disk with room for ``room`` bytes; half of the write that does not fit is written."""

    room = 64_000

    def write(self, data: bytes) -> int:
        if self.tell() + len(data) > self.room:
            super().write(data[: max(0, self.room - self.tell())])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return super().write(data)


def test_a_full_disk_ends_the_file_after_the_last_whole_message(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is finished when there is room for it once more."""
    monkeypatch.setattr(mcap_writer, "Sink", FullDisk)
    writer = EpisodeWriter.begin(tmp_path, event("e", 0, "started"))
    sent = list(episode("e", frames=50))
    with pytest.raises(OSError, match="No space left"):
        write_all(writer, sent)
    before = writer.messages
    writer.write(observation("e", 49))
    partial = writer.seal()
    assert partial.name == "e.mcap.partial"
    assert read_recording(partial, FINGERPRINT).truncated
    monkeypatch.undo()
    # Of the message that did not fit all but its index may stand in the file.
    assert 10 < before <= len(read_all(go_on(partial, []))) <= before + 1 < len(sent)


def test_a_disk_too_full_for_the_index_leaves_what_is_finished_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent = list(episode("e"))
    monkeypatch.setattr(mcap_writer, "Sink", FullDisk)
    monkeypatch.setattr(FullDisk, "room", 10**9)
    writer = EpisodeWriter.begin(tmp_path, event("e", 0, "started"))
    write_all(writer, sent)
    monkeypatch.setattr(FullDisk, "room", writer.size + 100)
    partial = writer.seal()
    assert partial.name == "e.mcap.partial"
    assert writer.problem == "No space left on device"
    monkeypatch.undo()
    assert len(read_all(go_on(partial, []))) == len(sent)
