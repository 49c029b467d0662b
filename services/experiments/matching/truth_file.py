"""Ground truth of two traverses: the references that show the place of a query.

A truth file is a CSV file in UTF-8 with the columns query, reference_first and reference_last in
any order; other columns are ignored. Frames count from 0, and the interval includes the last
reference. If both references are empty, no reference shows the place. Queries without a row are not
evaluated. A query has several rows if references show its place several times.

Alternatively, frames of equal names or nearby positions show the same place.
"""

import csv
import math
import re
from collections.abc import Callable, Sequence
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from schemas.codec import printable
from services.experiments.matching.sources import TraverseSource, loaded
from services.kit.errors import UsageError
from smal.evaluation.ground_truth import IntervalTruth

COLUMNS: Final = ("query", "reference_first", "reference_last")
POSE_COLUMNS: Final = ("frame", "x_m", "y_m")
# Metres per degree of latitude, and EXIF tag of the position of a camera.
_DEGREE_M = 111_195.0
_GPS = 0x8825
Positions = NDArray[np.float64]  # x and y of frames in metres (n, 2); NaN if unknown.


def read_truth(path: Path, queries: int, references: int) -> IntervalTruth:
    """Read the file of `--truth` for traverses of these lengths; raise UsageError with the line."""
    intervals: list[tuple[int, int, int]] = []
    judged = np.zeros(queries, dtype=np.bool_)
    unknown = np.zeros(queries, dtype=np.bool_)

    def take(row: dict[Any, Any]) -> None:
        query, interval = _interval(row, queries, references)
        if unknown[query] or (judged[query] and interval is None):
            raise ValueError(f"query {query} has several rows, and one of them marks it as unknown")
        judged[query] = True
        unknown[query] = interval is None
        if interval is not None:
            intervals.append((query, *interval))

    _read_table(path, "--truth", COLUMNS, take)
    return _truth(intervals, judged, f"--truth {path}")


def truth_by_names(
    references: Sequence[str], queries: Sequence[str], tolerance: int
) -> IntervalTruth:
    """Match frames of equal names, within a tolerance in frames; other frames are not evaluated."""
    numbers = {name: number for number, name in enumerate(references)}
    last = len(references) - 1
    pairs = [(query, numbers[name]) for query, name in enumerate(queries) if name in numbers]
    intervals = [
        (query, max(number - tolerance, 0), min(number + tolerance, last))
        for query, number in pairs
    ]
    judged = np.array([name in numbers for name in queries])
    return _truth(intervals, judged, "--truth names")


def truth_by_positions(
    references: Positions, queries: Positions, radius_m: float, named: str
) -> IntervalTruth:
    """Match frames within a radius; queries without a position are not evaluated."""
    known = np.flatnonzero(np.isfinite(references[:, 0]))
    judged = np.isfinite(queries[:, 0])
    tree = KDTree(references[known])
    intervals = list[tuple[int, int, int]]()
    for query in np.flatnonzero(judged).tolist():
        near = known[sorted(tree.query_ball_point(queries[query], radius_m))]
        for run in np.split(near, np.flatnonzero(np.diff(near) > 1) + 1):
            intervals.extend([(query, int(run[0]), int(run[-1]))] if run.size else [])
    return _truth(intervals, judged, named)


def read_positions(path: Path, frames: int) -> Positions:
    """Read a file of `--poses`: x_m and y_m by frame, counted from 0."""
    positions = np.full((frames, 2), np.nan)

    def take(row: dict[Any, Any]) -> None:
        place = [float(row[name] or "") for name in POSE_COLUMNS[1:]]
        if not all(map(math.isfinite, place)):
            raise ValueError(
                "x_m and y_m must be finite; leave out the row of a frame without a position"
            )
        positions[_frame(row, "frame", frames)] = place

    _read_table(path, "--poses", POSE_COLUMNS, take)
    return positions


def gps_positions(
    references: TraverseSource, queries: TraverseSource
) -> tuple[Positions, Positions]:
    """Return the EXIF positions of images, metres on one plane; raise UsageError without any."""
    degrees = []
    for source in (references, queries):
        degrees.append(np.array([_latitude_longitude(loaded(one)) for one in source.pictures()]))
        if not np.isfinite(degrees[-1]).any():
            raise UsageError(f"--truth gps: no EXIF position in the images of {source.path}")
    latitude, longitude = np.nanmean(degrees[0], axis=0)
    scale = _DEGREE_M * np.array([math.cos(math.radians(latitude)), 1.0])
    first, second = (
        np.mod(each[:, ::-1] - (longitude, latitude) + 180.0, 360.0) - 180.0 for each in degrees
    )
    return first * scale, second * scale


def _latitude_longitude(data: bytes | None) -> tuple[float, float]:
    from PIL import Image  # noqa: PLC0415 - no other truth needs it

    try:
        gps = Image.open(BytesIO(data or b"")).getexif().get_ifd(_GPS)
        parts = [float(np.array(gps[tag], float) @ [1.0, 1 / 60, 1 / 3600]) for tag in (2, 4)]
    except (
        OSError,
        SyntaxError,
        LookupError,
        TypeError,
        ValueError,
        ArithmeticError,
        Image.DecompressionBombError,
    ):
        return math.nan, math.nan
    return parts[0] * (-1 if gps.get(1) == "S" else 1), parts[1] * (-1 if gps.get(3) == "W" else 1)


def _truth(
    intervals: list[tuple[int, int, int]], judged: NDArray[np.bool_], named: str
) -> IntervalTruth:
    if not intervals:
        raise UsageError(f"{named}: no query has a reference; nothing to find")
    query, first, last = np.array(intervals, dtype=np.int64).T
    return IntervalTruth(query, first, last, judged)


def _read_table(
    path: Path, option: str, columns: Sequence[str], take: Callable[[dict[Any, Any]], None]
) -> None:
    """Take each row of a CSV file; convert ValueError to UsageError with the line."""
    try:
        # Spreadsheets begin UTF-8 with a byte order mark.
        text = path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise UsageError(f"{option} {path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise UsageError(f"{option} {path}: not UTF-8") from None
    table = csv.DictReader(StringIO(text, newline=""), strict=True)
    try:
        table.fieldnames = [name.strip() for name in table.fieldnames or ()]
        for name in columns:
            if table.fieldnames.count(name) != 1:
                raise ValueError(
                    f"needs the column {name} once; the columns are "
                    f"{_quoted(','.join(table.fieldnames))}"
                )
        for row in table:
            if None in row:
                raise ValueError("has more values than columns")
            take(row)
    except (ValueError, csv.Error) as error:
        raise UsageError(
            f"{option} {path}: line {max(1, table.reader.line_num)}: {error}"
        ) from None


def _interval(
    row: dict[Any, Any], queries: int, references: int
) -> tuple[int, tuple[int, int] | None]:
    """Return query, first and last reference of a row; None for a place without references."""
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
        raise ValueError(
            f"{name} {int(text)} is too large: the traverse has {count} frames, counted from 0"
        )
    return int(text)


def _quoted(text: str) -> str:
    return repr(printable(text, 60))
