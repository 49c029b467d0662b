"""Columns of Parquet files, a few thousand rows at a time, with limits."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np

from schemas.codec import printable
from services.importers.drive import MOST_SAMPLES, Array, ImportFailure
from services.importers.inside import Inside

#: Rows at a time: of numbers, and of images.
ROWS: Final = 4096
IMAGES: Final = 16
#: Most bytes of a file's own description, and entries of it; that of ten million rows has some hundred thousand.
_MOST_BYTES, _MOST_ENTRIES = 64 * 2**20, 10_000_000
#: Widest row; of an action it has some ten numbers.
_WIDEST: Final = 4096


def batches(inside: Inside, name: str, columns: Sequence[str], rows: int = ROWS) -> Iterator[Any]:
    """Yield record batches of the columns that there are.

    Raises
    ------
    ImportFailure
        When the file is not there, is none, or is larger than any drive.
    """
    import pyarrow as pa  # noqa: PLC0415 - of the extra `formats`
    import pyarrow.parquet as pq  # noqa: PLC0415

    called = inside.called(name)
    try:
        with inside.open(name) as file:
            table = pq.ParquetFile(
                file, thrift_string_size_limit=_MOST_BYTES, thrift_container_size_limit=_MOST_ENTRIES
            )
            if table.metadata.num_rows > MOST_SAMPLES:
                raise ImportFailure(
                    f"{called}: announces {table.metadata.num_rows} rows, at most {MOST_SAMPLES} are read"
                )
            there = [column for column in columns if column in table.schema_arrow.names]
            yield from table.iter_batches(batch_size=rows, columns=there, use_threads=False)
    except (pa.ArrowException, OSError, ValueError, MemoryError) as error:
        raise ImportFailure(f"{called}: not a Parquet file that can be read: {printable(str(error))}") from None


def numbers(batch: Any, column: str, called: str) -> Array:  # noqa: ANN401 - of a package without types
    """Return a column of numbers, (n,), or of lists of as many numbers each, (n, width).

    Raises
    ------
    ImportFailure
        When it is missing or is something else.
    """
    import pyarrow as pa  # noqa: PLC0415

    if column not in batch.schema.names:
        raise ImportFailure(f"{called}: lacks the column {printable(column)}")
    values = batch.column(column)
    count = len(values)
    try:
        if pa.types.is_nested(values.type):
            flat = values.flatten().to_numpy(zero_copy_only=False)
            if count and (len(flat) % count or len(flat) > _WIDEST * count or values.null_count):
                raise ImportFailure(f"{called}: the rows of {printable(column)} are not equally long")
            return np.asarray(flat, dtype=np.float64).reshape(count, -1)
        return np.asarray(values.to_numpy(zero_copy_only=False), dtype=np.float64)
    except (pa.ArrowException, ValueError, TypeError, AttributeError):
        raise ImportFailure(f"{called}: {printable(column)} is not a column of numbers") from None
