"""One episode's MCAP file, from its first message to its seal."""

from __future__ import annotations

import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final, cast

from mcap.writer import CompressionType, Writer

from schemas.base import Message
from schemas.episode import Episode
from schemas.topics import TOPICS
from services.recorder.encoding import format_of, payload_of
from services.recorder.ledger import Ledger
from services.recorder.recovery import RecoveryError, finish
from services.recorder.sink import Sink, free_path, partial_of, publish

#: Names of the metadata records: what the episode is (written first), and what the recording lacks (written last).
EPISODE_METADATA: Final = "smal.episode"
GAPS_METADATA: Final = "smal.gaps"


class EpisodeWriter:
    """Writes the messages of one episode.

    The file is called ``<episode>.mcap.partial`` until it is sealed. Every message is a chunk of its own, uncompressed,
    and whole in the file when ``write`` returns. Bigger chunks would be lost in a crash; without any, a viewer has no
    index to seek by, and Foxglove refuses more than 1 GB.

    Parameters
    ----------
    folder
        Where the file goes.
    started
        The event that begins the episode.

    Raises
    ------
    OSError
        When the file cannot be made.
    """

    def __init__(self, folder: Path, started: Episode) -> None:
        self.path = free_path(folder, started.episode)
        self.ledger = Ledger()
        self.messages = 0
        self.problem: str | None = None
        self._channels: dict[str, int] = {}
        self._schemas: dict[type[Message], int] = {}
        self._metadata = {"robot": started.robot, "episode": started.episode}
        self._sink = Sink(partial_of(self.path))
        try:
            # The writer asks its output for no more than write, tell and flush.
            self._writer = Writer(cast("Any", self._sink), compression=CompressionType.NONE)
            self._writer.start(profile="", library=f"smal {_software()}")
            self._writer.add_metadata(EPISODE_METADATA, self._metadata | _description(started))
        except OSError:
            self._sink.close()
            partial_of(self.path).unlink(missing_ok=True)
            raise
        self._whole = self._sink.tell()

    @property
    def size(self) -> int:
        """Bytes written."""
        return self._whole

    def write(self, message: Message) -> None:
        """Write a message, if it is new.

        Raises
        ------
        OSError
            When it cannot be written, for example because the disk is full; the file is then cut after the last
            whole message and takes no more.
        """
        if self.problem is not None or not self.ledger.admit(message):
            return
        payload = payload_of(message)
        try:
            self._writer.add_message(self._channel(message), message.stamp_ns, payload, message.stamp_ns, message.tick)
            self._writer.flush()  # type: ignore[no-untyped-call]
        except OSError as error:
            self.problem = error.strerror or str(error)
            raise
        self._whole = self._sink.tell()
        self.messages += 1

    def seal(self, end_tick: int | None = None) -> Path:
        """Finish the file and give it its name.

        Parameters
        ----------
        end_tick
            Tick at which the episode ended; None if it has not.

        Returns
        -------
        Path
            The recording. It still has the name of an unfinished one if there is no room even for the index; the next
            recorder that starts in this folder finishes it then.
        """
        if end_tick is not None:
            self.ledger.close(end_tick)
        try:
            self._finish()
            publish(partial_of(self.path), self.path)
        except OSError as error:
            self.problem = self.problem or error.strerror or str(error)
            return partial_of(self.path)
        finally:
            self._sink.close()
        return self.path

    def _finish(self) -> None:
        if self.problem is None:
            try:
                notes = {"duplicates": str(self.ledger.duplicates)} | self.ledger.gaps()
                self._writer.add_metadata(GAPS_METADATA, notes)
                self._writer.finish()  # type: ignore[no-untyped-call]
                self._sink.sync()
            except OSError as error:
                self.problem = error.strerror or str(error)
            else:
                return
        # What the writer believes to have written is not what stands in the file: index what does.
        self._sink.truncate(self._whole)
        try:
            finish(self._sink.fileno())
        except RecoveryError as error:
            raise OSError(str(error)) from None

    def _channel(self, message: Message) -> int:
        topic, kind = message.topic_name, type(message)
        channel = self._channels.get(topic)
        if channel is None:
            form = format_of(kind)
            if kind not in self._schemas:
                self._schemas[kind] = self._writer.register_schema(form.schema_name, form.schema_encoding, form.schema)
            key = TOPICS[topic].key(message.robot)
            channel = self._writer.register_channel(key, form.message_encoding, self._schemas[kind], self._metadata)
            self._channels[topic] = channel
        return channel


def _description(started: Episode) -> dict[str, str]:
    return {
        "world": started.world,
        "seed": str(started.seed),
        "purpose": started.purpose,
        "driver": started.driver,
        "software": _software(),
        "recorded_utc": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }


def _software() -> str:
    try:
        return version("smal")
    except PackageNotFoundError:
        return "unknown"
