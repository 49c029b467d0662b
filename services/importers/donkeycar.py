"""Tubs of donkeycar, version 2: a manifest, catalogs of JSON lines, and JPEGs.

Steering and throttle are shares of full lock and full throttle. The turn rate of a car is their
product. A tub has no units for them: odometry is computed only if the user gives the speeds.
"""

from collections.abc import Iterator
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from services.importers.drive import MOST_SAMPLES, ImportedDrive, ImportFailure, Tally
from services.importers.images import Row, drive_of
from services.importers.inside import Inside
from services.importers.job import ImportJob

_Whole = Annotated[int, Field(ge=0, le=2**53)]


class _Manifest(BaseModel):
    """The last of the five lines of a manifest."""

    paths: list[str]
    current_index: int
    deleted_indexes: set[int]


class _Record(BaseModel):
    """A line of a catalog."""

    model_config = ConfigDict(coerce_numbers_to_str=True)
    index: _Whole = Field(alias="_index")
    time_ms: FiniteFloat = Field(alias="_timestamp_ms")
    image: str = Field(alias="cam/image_array")
    angle: FiniteFloat = Field(alias="user/angle")
    throttle: FiniteFloat = Field(alias="user/throttle")
    mode: str = Field(default="user", alias="user/mode")
    session: str = Field(default="", alias="_session_id")


def read(inside: Inside, job: ImportJob, tally: Tally) -> list[ImportedDrive]:
    """Read a tub; each session is a drive, and so is a tub without sessions."""
    manifest = _manifest(inside)
    sessions: dict[str, list[Row]] = {}
    found = 0
    for found, record in enumerate(_records(inside, manifest.paths, tally), 1):
        if found > MOST_SAMPLES:
            raise ImportFailure(f"{inside.path}: too large (more than {MOST_SAMPLES} records)")
        if record is not None and _is_usable(record, manifest, tally):
            sessions.setdefault(record.session, []).append(_row(record, job))
    if found != manifest.current_index:
        tally.say(
            f"the manifest announces {manifest.current_index} records, the catalogs have {found}"
        )
    if not sessions:
        raise ImportFailure(
            f"{inside.path}: no record in this tub has an image, an angle and a throttle"
        )
    metric = job.speed is not None and job.turn_rate is not None
    return [drive_of(inside, name, rows, tally, metric=metric) for name, rows in sessions.items()]


def _manifest(inside: Inside) -> _Manifest:
    lines = inside.read("manifest.json").splitlines()
    if len(lines) < 5:
        raise ImportFailure(
            f"{inside.called('manifest.json')}: invalid: the manifest of a tub of version 2 "
            "has five lines"
        )
    return inside.parsed(_Manifest, lines[4], "manifest.json")


def _is_usable(record: _Record, manifest: _Manifest, tally: Tally) -> bool:
    deleted = record.index in manifest.deleted_indexes
    if record.mode != "user":
        tally.count("records were not driven by a person")
    elif deleted:
        tally.count("records were deleted by their owner")
    return record.mode == "user" and not deleted


def _row(record: _Record, job: ImportJob) -> Row:
    time_s = record.time_ms / 1000.0 if job.rate_hz is None else record.index / job.rate_hz
    # A joystick can exceed full throttle, a car cannot. An angle of -1 is full left.
    throttle = min(max(record.throttle, -1.0), 1.0)
    angle = min(max(record.angle, -1.0), 1.0)
    velocity = throttle * (job.speed or 1.0), -angle * throttle * (job.turn_rate or 1.0)
    return Row(f"images/{record.image}", time_s, velocity)


def _records(inside: Inside, paths: list[str], tally: Tally) -> Iterator[_Record | None]:
    """Yield all records; None for a malformed record."""
    catalogs = {inside.regular(path): path for path in dict.fromkeys(paths)}
    tally.count("names of catalogs are repeated (read once)", len(paths) - len(catalogs))
    for path in catalogs.values():
        for line in filter(bytes.strip, inside.lines(path)):
            try:
                yield inside.parsed(_Record, line, path)
            except ImportFailure:
                tally.count("records lack an image, an angle, a throttle or a time")
                yield None
