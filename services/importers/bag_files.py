"""The messages in the files of a bag: MCAP by our own reader, which survives damage and bombs, and SQLite."""

import re
import sqlite3
import struct
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, Final, NamedTuple
from urllib.parse import quote

from mcap.exceptions import McapError
from mcap.records import Channel, Message, Schema
from zstandard import ZstdDecompressor, ZstdError

from schemas.codec import printable
from services.importers.drive import ImportFailure, Tally
from services.importers.inside import Inside
from services.recordings.records import MAGIC, mapped, records

_ZSTD: Final = b"\x28\xb5\x2f\xfd"
_MOST_BYTES: Final = 4 * 4096 * 3072 + 2**20  # Largest message: a raw image of 4096x3072x4, and more.


class Received(NamedTuple):
    """One message of a bag."""

    topic: str
    type: str
    time_s: float
    data: bytes


def received(inside: Inside, tally: Tally, topic: str | None = None) -> Iterator[Received]:
    """Yield the messages of a bag, of one topic or of all; ImportFailure when there is none, or a file is damaged."""
    for name in _files(inside):
        path = inside.regular(name)
        messages = _of_sqlite(path, tally) if path.suffix == ".db3" else _of_mcap(path, tally)
        try:
            for message in messages:
                if topic in (None, message.topic):
                    yield message._replace(data=_unpacked(message.data))
        except (McapError, struct.error, ValueError, sqlite3.Error, MemoryError, OverflowError) as error:
            reason = printable(str(error)) or type(error).__name__
            raise ImportFailure(f"{inside.called(name)}: damaged: {reason}") from None


def _files(inside: Inside) -> list[str]:
    suffixes = (".mcap", ".db3")
    if not inside.is_folder:
        if inside.path.suffix not in suffixes:
            raise ImportFailure(f"{inside.path}: not a bag: a folder, or a file *.mcap or *.db3")
        return [""]
    names = inside.names()
    found = sorted((name for name in names if name.endswith(suffixes)), key=_by_number)
    if not found:
        bags = [name for name in names if "metadata.yaml" in inside.names(name)]
        more = [f"; {printable(name)} in it is a bag: import each by itself" for name in bags]
        more += [f"; unpack {printable(name)} first: zstd -d" for name in names if name.endswith(".zstd")]
        raise ImportFailure(f"{inside.path}: no *.mcap and no *.db3 in this folder{[*more, ''][0]}")
    return found


def _by_number(name: str) -> tuple[int, str]:
    """Sort ``bag_10`` after ``bag_9``."""
    number = re.search(r"_(\d{1,9})\.\w+$", name)
    return int(number[1]) if number else 0, name


def _of_mcap(path: Path, tally: Tally) -> Iterator[Received]:
    data = mapped(path)
    if data[: len(MAGIC)] != MAGIC:
        raise McapError("not an MCAP file")
    if data[-len(MAGIC) :] != MAGIC:
        tally.say(f"{printable(path.name)}: its end is missing; the whole messages are read")
    types: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}
    for record in records(data):
        if isinstance(record, Schema):
            types[record.id] = record.name
        elif isinstance(record, Channel):
            if _is_cdr(record.message_encoding, tally):
                channels[record.id] = record.topic, types.get(record.schema_id, "")
        elif isinstance(record, Message) and record.channel_id in channels:
            yield Received(*channels[record.channel_id], record.log_time / 1e9, record.data)


def _of_sqlite(path: Path, tally: Tally) -> Iterator[Received]:
    with closing(sqlite3.connect(f"file:{quote(str(path))}?mode=ro&immutable=1", uri=True)) as database:
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MOST_BYTES)
        # A view could call itself, or compute for ever.
        database.execute("PRAGMA trusted_schema = OFF")
        kinds = dict(database.execute("SELECT name, type FROM sqlite_master WHERE name IN ('topics', 'messages')"))
        if kinds != {"topics": "table", "messages": "table"}:
            raise sqlite3.DatabaseError("no tables of topics and messages")
        topics: dict[Any, tuple[str, str]] = {}
        for number, name, kind, form in database.execute("SELECT id, name, type, serialization_format FROM topics"):
            if _is_cdr(form, tally):
                topics[number] = str(name), str(kind)
        # In the order in which they were received; to sort them by time could take as much room as they do.
        for number, stamp_ns, data in database.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY rowid"):
            if number in topics and isinstance(data, bytes) and isinstance(stamp_ns, int):
                yield Received(*topics[number], stamp_ns / 1e9, data)


def _is_cdr(encoding: object, tally: Tally) -> bool:
    tally.count(f"topics are {encoding or 'of no encoding'}, not ROS 2's CDR", int(encoding != "cdr"))
    return encoding == "cdr"


def _unpacked(data: bytes | memoryview) -> bytes:
    """Return a message; bags can have each packed by itself, and a packed one can claim to be of any size."""
    whole = bytes(data)
    if not whole.startswith(_ZSTD):
        return whole
    try:
        unpacked: bytes = ZstdDecompressor().stream_reader(whole).read(_MOST_BYTES + 1)
    except ZstdError as error:
        raise ValueError(f"a packed message: {error}") from None
    if len(unpacked) > _MOST_BYTES:
        raise ValueError(f"a packed message of more than {_MOST_BYTES} bytes")
    return unpacked
