"""A recording that is not sealed, or damaged, becomes a sealed one of all that is whole in it."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace as changed
from itertools import chain
from pathlib import Path

from mcap.records import Channel, Schema
from mcap.records import Message as StoredMessage

from schemas.topics import topic_of
from services.recordings.contents import Contents, decoded, verify
from services.recordings.encoding import ChannelFormat, decode_image, format_of
from services.recordings.reader import IMAGES, open_parts
from services.recordings.records import summary_of, surveyed
from services.recordings.sink import PARTIAL_SUFFIX, claim, finished, free_path, parts_of, publish
from services.recordings.writer import EpisodeWriter


class RepairError(Exception):
    """A recording cannot be repaired; the text names it and says why in one line."""


def usual_name(path: Path, *, replace: bool) -> Path:
    """Return where the repaired recording goes if nobody says; it is there already only where it replaces its own."""
    if path.suffix == PARTIAL_SUFFIX:
        return finished(path)
    return path if replace else free_path(path.parent, f"{path.stem}-repaired")


def repair(path: Path, out: Path, *, replace: bool = False) -> tuple[Contents, Contents | None]:
    """Write the recording of all that is whole in another one.

    Parameters
    ----------
    path
        A recording, finished or left behind, with its parts. It stays as it is.
    out
        The new one.
    replace
        Whether a file that is there is replaced, and the parts of what was left behind are removed.

    Returns
    -------
    before, after : Contents
        What was wrong, and what still is: what it lacks was lost before. None where nothing was to be repaired, and
        nothing is written.

    Raises
    ------
    RepairError
        When nothing can be made of it, it is still being recorded, or there is a file already.
    RecordingError
        When it is no recording.
    OSError
        When the new one cannot be written.
    """
    before = verify(path)
    if before.state == "sealed" and not before.damage:
        return before, None
    if len(before.episodes) != 1:
        several = f"{len(before.episodes)} episodes; one can be repaired at a time"
        raise RepairError(f"{path}: holds {several if before.episodes else 'nothing of an episode to save'}")
    with _locked(path), tempfile.TemporaryDirectory(prefix=".repair-", dir=out.parent) as folder:
        made = _written(path, Path(folder) / out.name, before)
        after = verify(made)
        if out.exists() and not replace:
            raise RepairError(f"{out}: is there already; give another name, or --replace")
        publish(made, out)
        if replace and path.suffix == PARTIAL_SUFFIX:
            for part in parts_of(path):
                part.unlink()
    after.path = out
    return before, after


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Keep recorders away from what one of them left behind."""
    if path.suffix != PARTIAL_SUFFIX:
        yield
        return
    try:
        lock = claim(path)
    except BlockingIOError:
        raise RepairError(f"{path}: still being recorded; end the episode or stop the recorder first") from None
    try:
        yield
    finally:
        os.close(lock)


def _written(path: Path, out: Path, before: Contents) -> Path:
    (episode,) = before.episodes
    metadata = {name: str(value) for name, value in episode.said.items()} | before.about
    metadata |= {"robot": episode.robot, "episode": episode.episode}
    writer = EpisodeWriter(out.with_name(f"{out.name}{PARTIAL_SUFFIX}"), out, metadata)
    try:
        for part in open_parts(path):
            _copy(part, writer)
    finally:
        sealed = writer.seal()
    if sealed != out:
        raise RepairError(f"{out.name}: cannot be written: {writer.problem}")
    return sealed


def _copy(part: memoryview, writer: EpisodeWriter) -> None:
    """Write what is whole in a part; `verify` has told of all else."""
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    summary = summary_of(part)
    for record in chain(() if summary is None else summary.records, surveyed(part, lambda _line: None)):
        match record:
            case Schema():
                schemas[record.id] = record
            case Channel(metadata={"robot": _, "episode": _}):
                channels[record.id] = record
            case StoredMessage(channel_id=number) if number in channels:
                channel = channels[number]
                # A message that does not decode is left out.
                with suppress(ValueError):
                    writer.copy(channel.topic, _form(channel, schemas), _checked(channel, record))
            case _:
                pass


def _checked(channel: Channel, stored: StoredMessage) -> StoredMessage:
    """Return a message with the tick and the time that it tells itself; ValueError where it is none of ours."""
    topic, payload = topic_of(channel.topic), bytes(stored.data)
    if topic is None:
        raise ValueError(channel.topic)
    if topic in IMAGES:
        decode_image(payload)
        return stored
    message = decoded(topic, channel.metadata["robot"], channel.metadata["episode"], payload)
    return changed(stored, sequence=message.tick, log_time=message.stamp_ns)


def _form(channel: Channel, schemas: dict[int, Schema]) -> ChannelFormat:
    """Return how the messages of a channel are written; as today where its schema is lost."""
    schema, topic = schemas.get(channel.schema_id), topic_of(channel.topic)
    if schema is not None:
        return ChannelFormat(schema.name, schema.encoding, channel.message_encoding, bytes(schema.data))
    if topic is None:
        raise ValueError(channel.topic)
    return format_of(topic.message)
