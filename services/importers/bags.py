"""Messages of a bag: ROS 2 (MCAP or SQLite) or ROS 1, a folder or a file.

Types are those of ROS, not the definitions in a bag. Our MCAP reader tolerates a missing end.
"""

import re
import sqlite3
import struct
from collections.abc import Iterator
from contextlib import closing
from functools import cache
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
#: Largest message: a raw image of 4096x3072x4 and its header.
_MOST_BYTES: Final = 4 * 4096 * 3072 + 2**20
#: Bytes of a row beside its blob: two lengths, and a header of at least three columns.
_LEAST_ROW: Final = 6
_STEM: Final = re.compile(r"(?P<bag>.+?)(_(?P<part>\d{1,9}))?", re.DOTALL)
#: Bytes before the text of a header's frame, in the messages of both ROS versions.
_FRAME_AT: Final = 16


class Received(NamedTuple):
    """One message of a bag."""

    topic: str
    type: str
    time_s: float  # Time of reception.
    data: bytes
    ros1: bool = False


class Header(NamedTuple):
    """The header at the begin of a message."""

    stamp_s: float  # Time of capture, 0 if the clock was not set.
    frame: str


def is_bag(name: str) -> bool:
    """Return whether a file is part of a bag by its name."""
    return Path(name).suffix in _READERS


def bags_of(inside: Inside) -> dict[str, list[str]]:
    """Return the files of each bag by its name, in a folder or in the folders below it."""
    if not inside.is_folder:
        return {inside.path.stem: [""]} if is_bag(inside.path.name) else {}
    bags: dict[str, list[str]] = {}
    for folder in inside.search(lambda names: any(map(is_bag, names))):
        parts = _parts(inside, folder)
        only = folder.rstrip("/") or inside.path.stem
        bags |= parts if len(parts) > 1 else {only: next(iter(parts.values()))}
    return bags


def _parts(inside: Inside, folder: str) -> dict[str, list[str]]:
    """Return the files of the bags in a folder: ``bag_0.mcap`` and ``bag_1.mcap`` are one bag."""
    files: dict[str, list[tuple[int, str]]] = {}
    for name in filter(is_bag, inside.names(folder)):
        found = _STEM.fullmatch(Path(name).stem)
        if found is not None:
            part = int(found["part"] or 0), f"{folder}{name}"
            files.setdefault(f"{folder}{found['bag']}", []).append(part)
    return {bag: [name for _, name in sorted(found)] for bag, found in files.items()}


def received(inside: Inside, names: list[str], tally: Tally) -> Iterator[Received]:
    """Yield the messages of the files of a bag; ImportFailure if one is damaged."""
    for name in names:
        path = inside.regular(name)
        try:
            for message in _READERS[path.suffix](path, tally):
                yield message._replace(data=_unpacked(message.data))
        except (
            McapError,
            struct.error,
            ValueError,
            sqlite3.Error,
            MemoryError,
            OverflowError,
        ) as error:
            reason = printable(str(error)) or type(error).__name__
            raise ImportFailure(f"{inside.called(name)}: damaged: {reason}") from None


def _of_mcap(path: Path, tally: Tally) -> Iterator[Received]:
    data = mapped(path)
    if data[: len(MAGIC)] != MAGIC:
        raise McapError("not an MCAP file")
    if data[-len(MAGIC) :] != MAGIC:
        tally.say(f"{printable(path.name)}: end missing; only complete messages are read")
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
    with closing(
        sqlite3.connect(f"file:{quote(str(path))}?mode=ro&immutable=1", uri=True)
    ) as database:
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MOST_BYTES)
        database.execute("PRAGMA trusted_schema = OFF")
        for table in ("topics", "messages"):
            _check_plain(database, table)
        topics: dict[Any, tuple[str, str]] = {}
        for number, name, kind, form in database.execute(
            "SELECT id, name, type, serialization_format FROM topics"
        ):
            if _is_cdr(form, tally):
                topics[number] = str(name), str(kind)
        # In the order of reception, because sorting by time can need as much memory as the
        # messages.
        left = path.stat().st_size
        for number, stamp_ns, data in database.execute(
            "SELECT topic_id, timestamp, data FROM messages ORDER BY rowid"
        ):
            left -= _LEAST_ROW + (len(data) if isinstance(data, bytes) else 0)
            if left < 0:
                raise sqlite3.DatabaseError("its messages are larger than the file")
            if number in topics and isinstance(data, bytes) and isinstance(stamp_ns, int):
                yield Received(*topics[number], stamp_ns / 1e9, data)


def _of_ros1(path: Path, _tally: Tally) -> Iterator[Received]:
    from rosbags.rosbag1 import Reader  # noqa: PLC0415 - of the extra `formats`

    try:
        with Reader(path) as reader:
            for connection, time_ns, data in reader.messages():
                yield Received(connection.topic, connection.msgtype, time_ns / 1e9, data, True)
    except (ImportFailure, MemoryError):
        raise
    except Exception as error:  # noqa: BLE001 - rosbags raises many for malformed bytes
        advice = "; close it first: rosbag reindex" if "not indexed" in str(error) else ""
        raise ValueError(f"{str(error) or type(error).__name__}{advice}") from None


_READERS: Final = {".mcap": _of_mcap, ".db3": _of_sqlite, ".bag": _of_ros1}


def _check_plain(database: sqlite3.Connection, table: str) -> None:
    """Reject a view, a virtual table or a generated column, which can compute forever."""
    found = database.execute(
        "SELECT type, rootpage FROM sqlite_master WHERE name = ?", (table,)
    ).fetchall()
    if (
        len(found) != 1 or found[0][0] != "table" or not found[0][1]
    ):  # A virtual table has no page of its own.
        raise sqlite3.DatabaseError("tables of topics and messages not found")
    for name, hidden in database.execute(
        "SELECT name, hidden FROM pragma_table_xinfo(?)", (table,)
    ):
        if hidden:
            raise sqlite3.DatabaseError(f"the column {name} of {table} is computed, not stored")


def _is_cdr(encoding: object, tally: Tally) -> bool:
    tally.count(
        f"unsupported encoding {encoding or '(empty)'} of topics, not ROS 2's CDR",
        int(encoding != "cdr"),
    )
    return encoding == "cdr"


def _unpacked(data: bytes | memoryview) -> bytes:
    """Return the bytes of a message, unpacked within a limit."""
    whole = bytes(data)
    if not whole.startswith(_ZSTD):
        return whole
    try:
        unpacked: bytes = ZstdDecompressor().stream_reader(whole).read(_MOST_BYTES + 1)
    except ZstdError as error:
        raise ValueError(f"invalid packed message: {error}") from None
    if len(unpacked) > _MOST_BYTES:
        raise ValueError(f"packed message too large (more than {_MOST_BYTES} bytes)")
    return unpacked


@cache
def typestore(ros1: bool = False) -> Any:  # noqa: ANN401 - of a package that may be missing
    """Return the types of ROS messages."""
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 - of the extra `formats`

    # The used types are equal in every distribution of ROS 2 from Foxy on.
    return get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY)


def decoded(message: Received) -> Any:  # noqa: ANN401 - as above
    """Decode a message; ValueError if its bytes do not fit its type."""
    store = typestore(message.ros1)
    decode = store.deserialize_ros1 if message.ros1 else store.deserialize_cdr
    try:
        return decode(message.data, message.type)
    except Exception as error:  # noqa: BLE001
        # rosbags raises many exceptions for malformed bytes.
        raise ValueError(type(error).__name__) from None


def header_of(message: Received) -> Header:
    """Return the header of a message without decoding the rest; ValueError if it is too short."""
    data = message.data
    little = message.ros1 or (len(data) > 1 and data[1] & 1)
    try:
        # The first four bytes are a counter in ROS 1, and the byte order in ROS 2.
        seconds, nanoseconds, length = struct.unpack_from("<III" if little else ">III", data, 4)
    except struct.error:
        raise ValueError("message too short for its header") from None
    frame = bytes(data[_FRAME_AT : _FRAME_AT + min(length, 255)])
    return Header(seconds + nanoseconds / 1e9, frame.rstrip(b"\0").decode(errors="replace"))
