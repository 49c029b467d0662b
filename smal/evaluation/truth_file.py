"""The truth of two image folders as a table that people write: which references show the place of a query."""

import csv
import re
from collections.abc import Iterator, Mapping
from io import StringIO
from pathlib import Path
from typing import Final

import numpy as np

from smal.evaluation.ground_truth import IntervalTruth

COLUMNS: Final = ("query", "reference_first", "reference_last")
_NUMBER: Final = re.compile(r"[0-9]{1,15}", re.ASCII)
_QUOTED: Final = 60


class TruthFileError(ValueError):
    """A file is not a usable truth; the message says in one line where and why."""


def read_truth(path: Path, queries: int, references: int) -> IntervalTruth:
    """Read a truth file: CSV in UTF-8 with the columns query, reference_first and reference_last in its first line.

    Frames are counted from 0, and the last reference belongs to the interval. Where both references are empty the
    reference traverse does not show the place. A query without a row is not judged. Columns may come in any order and
    others beside them; empty lines do not matter.

    Parameters
    ----------
    path : Path
    queries, references : int
        Frames of the two traverses.

    Raises
    ------
    TruthFileError
        One line with the file, the line in it, and what is wrong.
    """
    first, last, judged = np.full(queries, -1), np.full(queries, -1), np.zeros(queries, dtype=np.bool_)
    for line, row in _rows(path):
        try:
            query, *interval = _interval(row, queries, references)
            if judged[query]:
                raise ValueError(f"query {query} has a row already")
        except ValueError as error:
            raise TruthFileError(f"{path}: line {line}: {error}") from None
        first[query], last[query] = interval
        judged[query] = True
    if not judged.any():
        raise TruthFileError(f"{path}: there is no row after the columns' names")
    return IntervalTruth(first, last, judged)


def _rows(path: Path) -> Iterator[tuple[int, Mapping[str, str]]]:
    """Yield the rows with the number of the line each ends on."""
    reader = csv.DictReader(StringIO(_text(path), newline=""), restkey="", restval="", strict=True)
    try:
        names = reader.fieldnames = [name.strip() for name in reader.fieldnames or ()]
        missing = [name for name in COLUMNS if names.count(name) != 1]
        if missing:
            raise TruthFileError(
                f"{path}: line 1: needs the column {missing[0]} once; the columns are {_quoted(','.join(names))}"
            )
        for row in reader:
            if "" in row and "" not in names:
                raise TruthFileError(f"{path}: line {reader.line_num}: has more values than columns")
            yield reader.line_num, row
    except csv.Error as error:
        raise TruthFileError(f"{path}: line {reader.reader.line_num}: not CSV: {error}") from None


def _text(path: Path) -> str:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise TruthFileError(f"{path}: cannot be read: {error.strerror}") from error
    if not content.strip():
        raise TruthFileError(f"{path}: the file is empty")
    try:
        return content.decode("utf-8-sig")  # spreadsheets begin UTF-8 with a byte order mark
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise TruthFileError(f"{path}: line {line}: not UTF-8") from None


def _interval(row: Mapping[str, str], queries: int, references: int) -> tuple[int, int, int]:
    """Return query, first and last reference of a row, (-1, -1) where there is nothing to find."""
    query = _frame(row, "query", queries)
    if not any(row[name].strip() for name in COLUMNS[1:]):
        return query, -1, -1
    first, last = (_frame(row, name, references) for name in COLUMNS[1:])
    if first > last:
        raise ValueError(f"reference_first {first} is after reference_last {last}")
    return query, first, last


def _frame(row: Mapping[str, str], name: str, count: int) -> int:
    text = row[name].strip()
    if not _NUMBER.fullmatch(text):
        raise ValueError(f"{name} must be a frame's number, counted from 0, got {_quoted(text)}")
    if int(text) >= count:
        raise ValueError(f"{name} {int(text)} is beyond the traverse: it has {count} frames, counted from 0")
    return int(text)


def _quoted(text: str) -> str:
    """Return the beginning of a stranger's text with nothing in it that moves a terminal."""
    return repr("".join(c if c.isprintable() else "?" for c in text[:_QUOTED]))
