"""Tubs of donkeycar, and folders of tubs.

A tub of version 2 has a manifest, catalogs of JSON lines, and a folder of images. A tub of version
1 has a ``meta.json``, and a JSON file beside each image. Both list their fields: the steering of a
person is ``user/angle`` in most tubs, ``steering`` in others.

Steering and throttle are shares of full lock and full throttle. The turn rate of a car is their
product. A tub has no units for them: odometry is computed only if the user gives the speeds.
"""

import re
from collections.abc import Iterator, Sequence
from datetime import datetime
from functools import partial
from itertools import pairwise
from typing import Annotated, Any, Final, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, JsonValue, RootModel

from services.importers.drive import MOST_SAMPLES, ImportedDrive, ImportFailure, Reads, Tally
from services.importers.images import Row, drive_of
from services.importers.inside import Inside
from services.importers.job import ImportJob, choose

_Whole = Annotated[int, Field(ge=0, le=2**53)]
_Values = dict[str, JsonValue]
_MANIFEST: Final = "manifest.json"
_META: Final = "meta.json"
_EXCLUDED: Final = "exclude.json"
_RECORD: Final = re.compile(r"record_(\d{1,15})\.json")
_ANEW_S: Final = 1.0  # A clock that steps back further begins anew.
_IMAGES: Final = ("image_array", "image")  # Types of fields.


class _Catalogs(BaseModel):
    """The last of the five lines of a manifest of version 2."""

    paths: list[str]
    current_index: int
    deleted_indexes: set[int]


class _Meta(BaseModel):
    """The fields of a tub and their types."""

    inputs: list[str]
    types: list[str]


#: Fields of a tub that lists none.
_USUAL: Final = _Meta(
    inputs=["cam/image_array", "user/angle", "user/throttle"],
    types=["image_array", "float", "float"],
)


_Strings = RootModel[list[str]]
_Indexes = RootModel[set[int]]
_Line = RootModel[_Values]


class _Record(BaseModel):
    """A record as used."""

    model_config = ConfigDict(coerce_numbers_to_str=True)
    index: _Whole
    time_s: FiniteFloat
    image: str
    angle: FiniteFloat
    throttle: FiniteFloat
    mode: str
    session: str


class _Stored(NamedTuple):
    """The JSON of a record, its file, and values that the JSON lacks."""

    path: str
    data: bytes
    more: _Values


class _Tub(NamedTuple):
    """A tub: its records as stored, the folder of their images, and its fields."""

    stored: Iterator[_Stored]
    images: str
    meta: _Meta
    deleted: set[int]
    announced: int | None = None  # Number of records, if the tub has one.


def found(inside: Inside) -> bool:
    """Return whether a folder is a tub, or has tubs."""
    return inside.is_folder and any(True for _ in inside.search(_is_tub))


def read(inside: Inside, job: ImportJob, tally: Tally) -> Reads:
    """Return the reads of tubs; each session is a drive, and so is a tub without sessions."""
    job.check_used("a tub", "camera", "velocity", "rate_hz", "speed", "turn_rate")
    reads = {
        folder: partial(_drives, inside, folder, job, tally) for folder in inside.search(_is_tub)
    }
    if not reads:
        raise ImportFailure(
            f"{inside.path}: no tub in this folder (neither {_MANIFEST} nor record_*.json)"
        )
    return dict(reads)


def _is_tub(names: list[str]) -> bool:
    return _MANIFEST in names or any(map(_RECORD.fullmatch, names))


def _drives(inside: Inside, folder: str, job: ImportJob, tally: Tally) -> list[ImportedDrive]:
    second = _MANIFEST in inside.names(folder)
    tub = (_version_2 if second else _version_1)(inside, folder, tally)
    fields = _fields(tub.meta, job, inside.called(folder))
    sessions: dict[str, list[Row]] = {}
    count = 0
    for count, stored in enumerate(tub.stored, 1):
        if count > MOST_SAMPLES:
            raise ImportFailure(
                f"{inside.called(folder)}: too large (more than {MOST_SAMPLES} records)"
            )
        record = _record(inside, stored, fields, job, tally)
        if record is not None and _is_usable(record, tub.deleted, tally):
            sessions.setdefault(record.session, []).append(_row(record, tub.images, job))
    if tub.announced not in (None, count):
        tally.say(f"the manifest announces {tub.announced} records, the catalogs have {count}")
    if not sessions:
        raise ImportFailure(
            f"{inside.called(folder)}: no record in this tub has {', '.join(fields)} and a time; "
            "if it has no times, give the frame rate with --rate, for example --rate 20"
        )
    units: dict[str, Any] = {
        "metric": job.speed is not None and job.turn_rate is not None,
        "turn_rate": job.scale()[1],
    }
    return [
        drive_of(inside, f"{folder}{name}".rstrip("/"), rows, tally, **units)
        for session, all_rows in sessions.items()
        for name, rows in ([(session, all_rows)] if second else _runs(session, all_rows))
    ]


def _runs(session: str, rows: Sequence[Row]) -> Iterator[tuple[str, Sequence[Row]]]:
    """Split rows where the clock begins anew: records were appended to a tub of version 1."""
    times_s = np.array([row.time_s for row in rows])
    anew = np.flatnonzero(np.diff(times_s) < -_ANEW_S) + 1
    for number, (first, last) in enumerate(pairwise([0, *anew, len(rows)])):
        yield f"{session}-{number + 1}" if number else session, rows[first:last]


def _version_2(inside: Inside, folder: str, tally: Tally) -> _Tub:
    name = f"{folder}{_MANIFEST}"
    lines = inside.read(name).splitlines()
    if len(lines) < 5:
        raise ImportFailure(
            f"{inside.called(name)}: invalid: the manifest of a tub of version 2 has five lines"
        )
    inputs, types = (inside.parsed(_Strings, line, name).root for line in lines[:2])
    catalogs = inside.parsed(_Catalogs, lines[4], name)
    paths = {inside.regular(f"{folder}{path}"): f"{folder}{path}" for path in catalogs.paths}
    repeated = len(catalogs.paths) - len(paths)
    tally.count("names of catalogs are repeated (read once)", repeated)
    stored = (
        _Stored(path, line, {})
        for path in paths.values()
        for line in inside.lines(path)
        if line.strip()
    )
    meta = _Meta(inputs=inputs, types=types) if inputs else _USUAL
    return _Tub(stored, f"{folder}images/", meta, catalogs.deleted_indexes, catalogs.current_index)


def _version_1(inside: Inside, folder: str, _tally: Tally) -> _Tub:
    names = inside.names(folder)
    indexes = sorted(int(found[1]) for found in map(_RECORD.fullmatch, names) if found)
    named = ((index, f"{folder}record_{index}.json") for index in indexes)
    stored = (_Stored(name, inside.read(name), {"_index": index}) for index, name in named)
    meta = _USUAL
    if _META in names:
        meta = inside.parsed(_Meta, inside.read(f"{folder}{_META}"), f"{folder}{_META}")
    deleted = set[int]()
    if _EXCLUDED in names:
        excluded = f"{folder}{_EXCLUDED}"
        deleted = inside.parsed(_Indexes, inside.read(excluded), excluded).root
    return _Tub(stored, folder, meta, deleted)


def _fields(meta: _Meta, job: ImportJob, called: str) -> tuple[str, str, str]:
    """Choose the fields of the image, the steering and the throttle."""
    steering, _, throttle = (job.velocity or "").partition(",")
    images = [name for name, kind in zip(meta.inputs, meta.types, strict=False) if kind in _IMAGES]
    wanted = (
        ("image", job.camera or "", images),
        ("steering", steering.strip(), _ending(meta.inputs, ("angle", "steering"))),
        ("throttle", throttle.strip(), _ending(meta.inputs, ("throttle",))),
    )
    how = "--camera IMAGE and --velocity STEERING,THROTTLE"
    image, angle, throttle = (
        choose(f"{called}: {what}", wish, found, meta.inputs, how) for what, wish, found in wanted
    )
    return image, angle, throttle


def _ending(inputs: Sequence[str], endings: Sequence[str]) -> list[str]:
    """Return the fields of a person whose last part is one of these; else those of no pilot."""
    found = [name for name in inputs if name.rpartition("/")[2] in endings]
    return [name for name in found if name.startswith("user/")] or [
        name for name in found if not name.startswith("pilot/")
    ]


def _record(
    inside: Inside, stored: _Stored, fields: tuple[str, str, str], job: ImportJob, tally: Tally
) -> _Record | None:
    """Parse a record; count it and return None if it is malformed or incomplete."""
    image, angle, throttle = fields
    try:
        values = inside.parsed(_Line, stored.data, stored.path).root | stored.more
        used = {
            "index": values.get("_index"),
            "time_s": _time_s(values, job.rate_hz),
            "image": values.get(image),
            "angle": values.get(angle),
            "throttle": values.get(throttle),
            "mode": values.get("user/mode", "user"),
            "session": values.get("_session_id", ""),
        }
        return _Record.model_validate(used)
    except (ImportFailure, ValueError, TypeError, OverflowError):
        tally.count("records lack an image, an angle, a throttle or a time")
        return None


def _time_s(values: _Values, rate_hz: float | None) -> float:
    """Return the time of a record; milliseconds since the start, or a date, in version 1."""
    index = values.get("_index")
    if rate_hz is not None and isinstance(index, int):
        return index / rate_hz
    time_ms = values.get("_timestamp_ms", values.get("milliseconds"))
    if isinstance(time_ms, int | float):
        return time_ms / 1000.0
    return datetime.fromisoformat(str(values.get("timestamp"))).timestamp()


def _is_usable(record: _Record, deleted: set[int], tally: Tally) -> bool:
    if record.mode != "user":
        tally.count("records were not driven by a person")
    elif record.index in deleted:
        tally.count("records were deleted by their owner")
    return record.mode == "user" and record.index not in deleted


def _row(record: _Record, folder: str, job: ImportJob) -> Row:
    # A joystick can exceed full throttle, a car cannot. An angle of -1 is full left.
    throttle = min(max(record.throttle, -1.0), 1.0)
    angle = min(max(record.angle, -1.0), 1.0)
    speed, turn_rate = job.scale()
    velocity = throttle * speed, -angle * throttle * turn_rate
    # A tub of version 1 can store the whole path on the car.
    return Row(f"{folder}{record.image.rpartition('/')[2]}", record.time_s, velocity)
