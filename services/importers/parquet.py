"""Columns of Parquet files, a few thousand rows at a time, with limits."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np

from schemas.codec import printable
from services.importers.drive import MOST_SAMPLES, Array, ImportFailure
from services.importers.inside import Inside

#: Rows at a time.
_ROWS: Final = 4096
#: Most bytes of a file's own description, and entries of it; that of ten million rows has some hundred thousand.
_MOST_BYTES, _MOST_ENTRIES = 64 * 2**20, 10_000_000
EPISODE: Final = "episode_index"


def batches(
    inside: Inside, name: str, columns: Sequence[str], episode: int | None = None, rows: int = _ROWS
) -> Iterator[Any]:
    """Yield record batches of the columns, of one episode or of all.

    Raises
    ------
    ImportFailure
        When the file is not there, is none, lacks a column, or is larger than any drive.
    """
    import pyarrow as pa  # noqa: PLC0415 - of the extra `formats`
    import pyarrow.compute as pc  # noqa: PLC0415
    import pyarrow.parquet as pq  # noqa: PLC0415

    called = inside.called(name)
    limits = {"thrift_string_size_limit": _MOST_BYTES, "thrift_container_size_limit": _MOST_ENTRIES}
    try:
        with inside.open(name) as file:
            table = pq.ParquetFile(file, **limits)
            count = table.metadata.num_rows
            if count > MOST_SAMPLES:
                raise ImportFailure(f"{called}: announces {count} rows, at most {MOST_SAMPLES} are read")
            for column in (EPISODE, *columns):
                if column not in table.schema_arrow.names:
                    raise ImportFailure(f"{called}: lacks the column {printable(column)}")
            for batch in table.iter_batches(batch_size=rows, columns=[EPISODE, *columns], use_threads=False):
                yield batch if episode is None else batch.filter(pc.equal(batch.column(EPISODE), episode))
    except (pa.ArrowException, OSError, ValueError, MemoryError) as error:
        raise ImportFailure(f"{called}: not a Parquet file that can be read: {printable(str(error))}") from None


def numbers(inside: Inside, name: str, columns: Sequence[str], episode: int | None = None) -> list[Array]:
    """Return columns of numbers, of one episode or of all: (n,), or of lists of as many numbers each, (n, width).

    Raises
    ------
    ImportFailure
        As of `batches`, or when a column is something else.
    """
    parts: list[list[Array]] = [[] for _ in columns]
    for batch in batches(inside, name, columns, episode):
        if not batch.num_rows:
            continue
        for column, found in zip(columns, parts, strict=True):
            try:
                found.append(np.array(batch.column(column).to_pylist(), dtype=np.float64))
            except (ValueError, TypeError, OverflowError):
                raise _mixed(inside, name, column) from None
            if found[-1].shape[1:] != found[0].shape[1:]:
                raise _mixed(inside, name, column)
    return [np.concatenate(found) if found else np.zeros(0) for found in parts]


def _mixed(inside: Inside, name: str, column: str) -> ImportFailure:
    said = f"{inside.called(name)}: {printable(column)} is not a column of numbers, or its rows are not equally long"
    return ImportFailure(said)
