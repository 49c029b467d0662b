"""The truth of two image folders as a table that people write: which references show the place of a query.

A CSV file in UTF-8 with the columns query, reference_first and reference_last, named in its first line, in any order
and with others beside them. Frames are counted from 0, and the last reference belongs to the interval. Where both
references are empty the reference traverse does not show the place. A query without a row is not judged; one that the
references show several times has several.
"""

import csv
import re
from io import StringIO
from pathlib import Path
from typing import Any, Final

import numpy as np

from schemas.codec import printable
from services.kit.errors import UsageError
from smal.evaluation.ground_truth import IntervalTruth

COLUMNS: Final = ("query", "reference_first", "reference_last")


def read_truth(path: Path, queries: int, references: int) -> IntervalTruth:
    """Read the file of ``--truth`` for folders of so many frames.

    Raises UsageError when it is no truth of these folders, or there is nothing to find: one line that names the file,
    the line in it, and what is wrong.
    """
    intervals: list[tuple[int, int, int]] = []
    judged, unknown = np.zeros(queries, dtype=np.bool_), np.zeros(queries, dtype=np.bool_)
    try:
        # Spreadsheets begin UTF-8 with a byte order mark.
        text = path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise UsageError(f"--truth {path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise UsageError(f"--truth {path}: not UTF-8") from None
    table = csv.DictReader(StringIO(text, newline=""), strict=True)
    try:
        table.fieldnames = [name.strip() for name in table.fieldnames or ()]
        for name in COLUMNS:
            if table.fieldnames.count(name) != 1:
                raise ValueError(f"needs the column {name} once; the columns are {_quoted(','.join(table.fieldnames))}")
        for row in table:
            query, interval = _interval(row, queries, references)
            if unknown[query] or (judged[query] and interval is None):
                raise ValueError(f"query {query} has a row already, and one of them says that no reference shows it")
            judged[query], unknown[query] = True, interval is None
            if interval is not None:
                intervals.append((query, *interval))
    except (ValueError, csv.Error) as error:
        raise UsageError(f"--truth {path}: line {max(1, table.reader.line_num)}: {error}") from None
    if not intervals:
        raise UsageError(f"--truth {path}: no query has a reference, so that there is nothing to find")
    query_of, first, last = np.array(intervals, dtype=np.int64).T
    return IntervalTruth(query_of, first, last, judged)


def _interval(row: dict[Any, Any], queries: int, references: int) -> tuple[int, tuple[int, int] | None]:
    """Return query, and first and last reference of a row, None where there is nothing to find."""
    if None in row:
        raise ValueError("has more values than columns")
    query = _frame(row, "query", queries)
    if not any((row[name] or "").strip() for name in COLUMNS[1:]):
        return query, None
    first, last = (_frame(row, name, references) for name in COLUMNS[1:])
    if first > last:
        raise ValueError(f"reference_first {first} is after reference_last {last}")
    return query, (first, last)


def _frame(row: dict[str, str | None], name: str, count: int) -> int:
    text = (row[name] or "").strip()
    if not re.fullmatch("[0-9]{1,15}", text):
        raise ValueError(f"{name} must be a frame's number, counted from 0, got {_quoted(text)}")
    if int(text) >= count:
        raise ValueError(f"{name} {int(text)} is beyond the traverse: it has {count} frames, counted from 0")
    return int(text)


def _quoted(text: str) -> str:
    return repr(printable(text, 60))
