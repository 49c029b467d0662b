"""Tubs of donkeycar, version 2: a manifest, catalogs of JSON lines, and JPEGs.

Steering and throttle are shares of full lock and full throttle. A car turns as fast as it drives and steers, so that
the turn rate is their product; what they are in metres and radians a second nobody wrote down, so that a way is
reckoned only where the user says it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from schemas.codec import printable
from services.importers.drive import MOST_SAMPLES, Drive, Frame, ImportFailure, Motion, Source, Tally
from services.importers.image_files import check_rate, image_file
from services.importers.inside import Inside, parsed
from services.importers.source_options import Wishes

_IMAGE, _ANGLE, _THROTTLE, _MODE, _SESSION = (
    "cam/image_array", "user/angle", "user/throttle", "user/mode", "_session_id",
)  # fmt: skip


class _Record(NamedTuple):
    number: int
    time_s: float
    image: str
    angle: float
    throttle: float
    session: str


def read(inside: Inside, wishes: Wishes, tally: Tally) -> Source:
    """Read a tub; each of its sessions is a drive, and so is a tub of a version without sessions."""
    lines = inside.read("manifest.json").splitlines()
    if len(lines) < 5:
        raise ImportFailure(f"{inside.called('manifest.json')}: not the manifest of a tub of version 2: five lines")
    catalogs = parsed(lines[4], inside.called("manifest.json"))
    try:
        paths, deleted = [str(one) for one in catalogs["paths"]], {int(one) for one in catalogs["deleted_indexes"]}
        announced = int(catalogs["current_index"])
    except (KeyError, TypeError, ValueError, OverflowError):
        raise ImportFailure(
            f"{inside.called('manifest.json')}: its fifth line lacks paths, current_index or deleted_indexes"
        ) from None
    records, found = _records(inside, paths, deleted, wishes.rate_hz, tally)
    if found != announced:
        tally.say(f"the manifest announces {printable(str(announced))} records, the catalogs have {found}")
    if not records:
        raise ImportFailure(f"{inside.path}: no record in this tub has an image, an angle and a throttle")
    sessions: dict[str, list[_Record]] = {}
    for record in records:
        sessions.setdefault(record.session, []).append(record)
    return Source(
        [_drive(inside, name, session, wishes, tally) for name, session in sessions.items()],
        metric=wishes.speed is not None and wishes.turn_rate is not None,
    )


def _records(
    inside: Inside, paths: list[str], deleted: set[int], rate_hz: float | None, tally: Tally
) -> tuple[list[_Record], int]:
    records, found = [], 0
    for path in paths:
        for line in inside.lines(path):
            if not line.strip():
                continue
            found += 1
            if found > MOST_SAMPLES:
                raise ImportFailure(f"{inside.path}: more than {MOST_SAMPLES} records")
            try:
                record = _record(parsed(line, inside.called(path)), rate_hz)
            except (ImportFailure, KeyError, TypeError, ValueError, OverflowError):
                tally.count("records lack an image, an angle, a throttle or a time")
                continue
            if record is None:
                tally.count("records were not driven by a person")
            elif record.number in deleted:
                tally.count("records were deleted by their owner")
            else:
                records.append(record)
    return records, found


def _record(values: dict[str, Any], rate_hz: float | None) -> _Record | None:
    index = int(values["_index"])
    time_s = float(values["_timestamp_ms"]) / 1000.0 if rate_hz is None else index / rate_hz
    angle, throttle = (float(values[name]) for name in (_ANGLE, _THROTTLE))
    if not all(map(math.isfinite, (time_s, angle, throttle))) or not isinstance(values[_IMAGE], str):
        raise ValueError("no number")
    if values.get(_MODE, "user") != "user":
        return None
    return _Record(index, time_s, values[_IMAGE], angle, throttle, str(values.get(_SESSION, "")))


def _drive(inside: Inside, name: str, session: list[_Record], wishes: Wishes, tally: Tally) -> Drive:
    check_rate(np.array([record.time_s for record in session]), inside)
    speed, turn_rate = wishes.speed or 1.0, wishes.turn_rate or 1.0
    # Of donkeycar -1 is full left; no car does more than all, whatever the joystick says.
    shares = [(r.time_s, *np.clip((r.throttle, r.angle), -1.0, 1.0).tolist()) for r in session]
    rows = [(time_s, speed * throttle, -turn_rate * angle * throttle) for time_s, throttle, angle in shares]

    def frames() -> Iterator[Frame]:
        for record in session:
            yield Frame(record.time_s, partial(image_file, inside, f"images/{record.image}", tally))

    return Drive(name, Motion.of(rows, tally), frames, len(session))
