"""Drives in the layouts of TUM, KITTI and EuRoC: images with times, and poses.

Poses give the velocities. TUM has ``rgb.txt``, or a folder ``rgb`` of images whose names are times,
and poses in a text file of eight numbers a line. KITTI has ``times.txt``, folders of images and
poses in a text file of twelve numbers a line, or ``sequences`` and ``poses``, or, as raw data,
``oxts``. EuRoC has, in ``mav0`` or not, a folder with a ``data.csv`` for each sensor.
"""

from collections.abc import Iterator, Sequence
from datetime import datetime
from functools import partial
from pathlib import PurePath
from typing import Final

import numpy as np
from pydantic import BaseModel, FiniteFloat, Json, PositiveInt
from scipy.spatial.transform import Rotation

from schemas.codec import describe, printable
from services.importers.drive import Array, ImportedDrive, ImportFailure, Reads, Tally
from services.importers.images import files
from services.importers.inside import Inside
from services.importers.job import ImportJob, choose
from services.importers.trajectory import track_of
from services.kit.cameras import calibrated
from services.kit.pixels import decode_file
from smal.camera import Camera

_RGB: Final = "rgb"
_LIST: Final = "rgb.txt"
_TIMES: Final = "times.txt"
_SEQUENCES: Final = "sequences"
_MAV: Final = "mav0"
_CAM: Final = "cam0"
_DATA: Final = "data.csv"
_MOST_NUMBERS: Final = 30  # Poses, velocities and the state of the inertial unit.
_OXTS: Final = "oxts"  # Satellite positions and orientations of KITTI, a file for each image.
_SENSOR: Final = "sensor.yaml"
_LENSES: Final = {"radial-tangential": "plumb_bob", "none": "plumb_bob"}
_EARTH_M: Final = 6_378_137.0


class _Sensor(BaseModel):
    """The calibration in lines of ``sensor.yaml`` of EuRoC."""

    resolution: Json[tuple[PositiveInt, PositiveInt]]
    intrinsics: Json[tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]]
    distortion_model: str = "plumb_bob"
    distortion_coefficients: Json[tuple[FiniteFloat, ...]] = ()


def found(inside: Inside) -> bool:
    """Return whether a folder has one of these layouts."""
    marks = (_LIST, _RGB, _TIMES, _SEQUENCES, _MAV, _CAM, _OXTS)
    return not set(marks).isdisjoint(inside.names())


def read(inside: Inside, job: ImportJob, tally: Tally) -> Reads:
    """Return the reads of the drives of a folder."""
    used = () if {_LIST, _RGB} & set(inside.names()) else ("camera",)
    job.check_used("a data set with poses", *used)
    names = inside.names()
    if _LIST in names or _RGB in names:
        return {inside.path.name: partial(_tum, inside, tally)}
    if _MAV in names or _CAM in names:
        folder = f"{_MAV}/" if _MAV in names else ""
        return {inside.path.name: partial(_euroc, inside, folder, job, tally)}
    if _OXTS in names:
        return {inside.path.name: partial(_kitti_raw, inside, job, tally)}
    if _TIMES in names:
        poses = _only(inside, _texts(inside), 12)
        return {inside.path.name: partial(_kitti, inside, "", poses, job, tally)}
    return _sequences(inside, job, tally)


def _tum(inside: Inside, tally: Tally) -> list[ImportedDrive]:
    # Other files, such as depth.txt and accelerometer.txt, have fewer numbers.
    poses = _table(inside, _only(inside, _texts(inside), 8), 8)
    if _LIST in inside.names():
        images = [line.split(maxsplit=1)[-1].strip() for line in _lines(inside, _LIST)]
        return _drive(inside, "", _times(inside, _LIST), images, poses, tally)
    names = [name for name in inside.names(_RGB) if _number(PurePath(name).stem) is not None]
    times_s = np.array([float(PurePath(name).stem) for name in names])
    order = np.argsort(times_s)
    images = [f"{_RGB}/{names[row]}" for row in order]
    return _drive(inside, "", times_s[order], images, poses, tally)


def _texts(inside: Inside) -> list[str]:
    return [name for name in inside.names() if name.lower().endswith(".txt")]


def _only(
    inside: Inside, names: Sequence[str], least: int, most: int = 0, delimiter: str | None = None
) -> str:
    """Return the only file of poses: its lines have so many numbers."""
    widths = range(least, max(least, most) + 1)
    found = [name for name in names if _width(inside, name, delimiter) in widths]
    if len(found) != 1:
        raise ImportFailure(
            f"{inside.path}: {len(found)} files of poses with {least} numbers a line among "
            f"{printable(', '.join(names))[:200] or 'no files'}; exactly one is needed"
        )
    return found[0]


def _sequences(inside: Inside, job: ImportJob, tally: Tally) -> Reads:
    """Return the reads of the sequences of KITTI that have poses."""
    every = inside.names(_SEQUENCES)
    known = set(inside.names("poses"))
    posed = [name for name in every if f"{name}.txt" in known]
    tally.count("sequences have no poses (left out)", len(every) - len(posed))
    return {
        name: partial(_kitti, inside, f"{_SEQUENCES}/{name}/", f"poses/{name}.txt", job, tally)
        for name in posed
    }


def _kitti(
    inside: Inside, folder: str, poses: str, job: ImportJob, tally: Tally
) -> list[ImportedDrive]:
    camera = _camera(inside, folder, "image_", job)
    times_s = _times(inside, f"{folder}{_TIMES}")
    images = [f"{folder}{camera}/{name}" for name in inside.names(f"{folder}{camera}")]
    if len(images) != len(times_s):
        tally.say(f"{folder}{camera} has {len(images)} images for {len(times_s)} times")
    matrices = _table(inside, poses, 12).reshape(-1, 3, 4)
    count = min(len(times_s), len(matrices), len(images))
    try:
        turns = Rotation.from_matrix(matrices[:count, :, :3]).as_quat()
    except ValueError:
        raise ImportFailure(f"{inside.called(poses)}: invalid: not matrices of rotations") from None
    placed = np.column_stack([times_s[:count], matrices[:count, :, 3], turns])
    lens = _kitti_lens(inside, f"{folder}calib.txt", f"P{camera[-1]}", images, tally)
    return _drive(inside, folder, times_s[:count], images[:count], placed, tally, lens)


def _kitti_raw(inside: Inside, job: ImportJob, tally: Tally) -> list[ImportedDrive]:
    camera = _camera(inside, "", "image_", job)
    images = [f"{camera}/data/{name}" for name in inside.names(f"{camera}/data")]
    files_of_poses = [f"{_OXTS}/data/{name}" for name in inside.names(f"{_OXTS}/data")]
    rows = np.concatenate(
        [_table(inside, name, 6) for name in files_of_poses] or [np.zeros((0, 6))]
    )
    latitude, longitude = np.radians(rows[:, :2]).T
    east = (longitude - longitude[:1]) * np.cos(latitude[:1])
    places = np.column_stack([_EARTH_M * east, _EARTH_M * (latitude - latitude[:1]), rows[:, 2]])
    turns = Rotation.from_euler("ZYX", rows[:, [5, 4, 3]]).as_quat()
    poses = np.column_stack([_dates(inside, f"{_OXTS}/timestamps.txt", len(rows)), places, turns])
    times_s = _dates(inside, f"{camera}/timestamps.txt", len(images))
    lens = _kitti_lens(inside, "calib_cam_to_cam.txt", f"P_rect_0{camera[-1]}", images, tally)
    return _drive(inside, "", times_s, images, poses, tally, lens)


def _kitti_lens(
    inside: Inside, path: str, name: str, images: Sequence[str], tally: Tally
) -> Camera | None:
    """Return the camera of a line of a calibration of rectified images; None without a file."""
    if PurePath(path).name not in inside.names(path.rpartition("/")[0]):
        return None
    rows = [line.split() for line in _lines(inside, path)]
    row = next((row[1:] for row in rows if row[0].rstrip(":") == name), [])
    try:
        pixels = decode_file(inside.read(images[0]))
        if pixels is None or len(row) != 12:
            raise ValueError(f"no 12 numbers of {name}")
        focal, column, line = (float(row[at]) for at in (0, 2, 6))
        return calibrated((pixels.shape[1], pixels.shape[0]), (focal, column, line))
    except (ValueError, IndexError) as error:
        tally.say(f"{inside.called(path)}: calibration not used: {printable(str(error))}")
        return None


def _dates(inside: Inside, name: str, count: int) -> Array:
    """Return the times of a file of dates, seconds since 1970."""
    try:
        dates = [datetime.fromisoformat(line).timestamp() for line in _lines(inside, name)]
    except (ValueError, OverflowError):
        raise ImportFailure(f"{inside.called(name)}: lines are not dates and times") from None
    if len(dates) != count:
        raise ImportFailure(f"{inside.called(name)}: {len(dates)} times for {count} files")
    return np.array(dates)


def _euroc(inside: Inside, folder: str, job: ImportJob, tally: Tally) -> list[ImportedDrive]:
    sensors = [f"{folder}{name}" for name in inside.folders(folder)]
    camera = f"{folder}{_camera(inside, folder, 'cam', job)}"
    listed = f"{camera}/{_DATA}"
    names = [line.rpartition(",")[2].strip() for line in _lines(inside, listed)]
    images = [f"{camera}/data/{name}" for name in names]
    tables = [f"{each}/{_DATA}" for each in sensors if _DATA in inside.names(each)]
    # An inertial unit has seven numbers a line.
    usual = [name for name in tables if "groundtruth" in name] or tables
    table = _table(inside, _only(inside, usual, 8, _MOST_NUMBERS, ","), 8, ",")
    placed = np.column_stack([table[:, 0] / 1e9, table[:, [1, 2, 3, 5, 6, 7, 4]]])
    lens = _euroc_lens(inside, camera, tally)
    return _drive(inside, "", _times(inside, listed, ",") / 1e9, images, placed, tally, lens)


def _euroc_lens(inside: Inside, folder: str, tally: Tally) -> Camera | None:
    """Return the camera of a ``sensor.yaml``; None without this file."""
    if _SENSOR not in inside.names(folder):
        return None
    name = f"{folder}/{_SENSOR}"
    try:
        lines = (line.partition(":") for line in _lines(inside, name))
        sensor = _Sensor.model_validate({key.strip(): value.strip() for key, _, value in lines})
        focal, _, column, row = sensor.intrinsics
        lens = _LENSES.get(sensor.distortion_model, sensor.distortion_model)
        return calibrated(
            sensor.resolution, (focal, column, row), lens, sensor.distortion_coefficients
        )
    except ValueError as error:
        why = printable(describe(error))
        tally.say(f"{inside.called(name)}: calibration not used: {why}")
        return None


def _camera(inside: Inside, folder: str, start: str, job: ImportJob) -> str:
    """Return the requested folder of images, or the usual one: the left colour camera of KITTI."""
    cameras = [name for name in inside.names(folder) if name.startswith(start)]
    usual = [name for name in cameras if name in ("image_2", "image_02", "cam0")] or cameras
    what = f"{inside.called(folder)}: camera {start}"
    return choose(what, job.camera, usual[:1], cameras, "--camera")


def _drive(
    inside: Inside,
    folder: str,
    times_s: Array,
    images: Sequence[str],
    poses: Array,
    tally: Tally,
    camera: Camera | None = None,
) -> list[ImportedDrive]:
    track = track_of(poses, tally)
    tally.say("velocities are computed from poses")
    name = folder.rstrip("/").rpartition("/")[2] or inside.path.name
    if not len(track):
        raise ImportFailure(f"{inside.called(folder)}: no pose of this drive is usable")
    rows = np.flatnonzero((times_s >= track[0, 0]) & (times_s <= track[-1, 0])).tolist()
    tally.count("frames have no pose (left out)", len(times_s) - len(rows))
    if not rows:
        raise ImportFailure(
            f"{inside.called(folder)}: no image at the times of the poses "
            f"({track[0, 0]:.1f} to {track[-1, 0]:.1f} s); both need the same clock"
        )
    shown = files([images[row] for row in rows], inside, tally)
    return [ImportedDrive.of_rows(name, times_s[rows], shown, [], track, tally, camera=camera)]


def _lines(inside: Inside, name: str) -> Iterator[str]:
    """Yield the lines of a text file without comments."""
    texts = (line.decode(errors="replace").partition("#")[0] for line in inside.lines(name))
    return filter(None, map(str.strip, texts))


def _width(inside: Inside, name: str, delimiter: str | None = None) -> int:
    """Return the number of numbers in a line of a text file; 0 if it has other text."""
    values = [_number(value) for value in next(_lines(inside, name), "").split(delimiter)]
    return 0 if None in values else len(values)


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _times(inside: Inside, name: str, delimiter: str | None = None) -> Array:
    return _table(inside, name, 1, delimiter)[:, 0]


def _table(inside: Inside, name: str, width: int, delimiter: str | None = None) -> Array:
    """Return the first columns of a text file of numbers, (n, width)."""
    rows = [line.split(delimiter)[:width] for line in _lines(inside, name)]
    try:
        return np.array(rows, dtype=np.float64).reshape(-1, width)
    except ValueError as error:
        raise ImportFailure(
            f"{inside.called(name)}: not a table of {width} numbers: {printable(str(error))[:200]}"
        ) from None
