"""LeRobotDataset, versions 2.0, 2.1 and 3.0: Parquet and MP4, of bases that are told a linear and an angular velocity.

Files have the names that the format prescribes; those that a data set writes down itself are not followed.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np

from schemas.codec import printable
from services.importers.drive import Array, Drive, Frame, ImportFailure, Motion, NotAnImage, Source, Tally, Track
from services.importers.images import as_jpeg
from services.importers.inside import Inside, parsed
from services.importers.parquet import IMAGES, batches, numbers
from services.importers.source_options import Wishes
from services.importers.video import frames_at, jpeg_of

#: Metres and radians a second; and a pose by the wheels, as only our own data sets have it.
VELOCITIES: Final = ("linear_velocity", "angular_velocity")
ACTION, STATE, SUCCESS = "action", "observation.state", "next.success"
POSE: Final = ("x_m", "y_m", "heading_rad")
#: What bases call their velocities, and what the angular one is in radians a second; LeKiwi has degrees.
_NAMES: Final = {
    ("x_vel", "theta_vel"): math.radians(1.0),
    **dict.fromkeys(
        [
            VELOCITIES,
            ("linear_vel", "angular_vel"),
            ("linear_x", "angular_z"),
            ("linear", "angular"),
            ("vx", "wz"),
        ],
        1.0,
    ),
}
#: Where they are looked for: what the robot was told says more of the driver than what it did.
_FEATURES: Final = (ACTION, STATE)
_SIDEWAYS: Final = ("y_vel", "linear_y", "vy")
#: Slower than this it does not go sideways, but is measured badly: `atoms` has the same for ahead.
_LEAST_SIDEWAYS: Final = 0.02
_V2: Final = ("data/chunk-{0:03d}/episode_{1:06d}.parquet", "videos/chunk-{0:03d}/{2}/episode_{1:06d}.mp4")
#: Files of version 3.0.
INFO: Final = "meta/info.json"
EPISODES: Final = "meta/episodes"
DATA: Final = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO: Final = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
_MOST_EPISODES: Final = 1_000_000


@dataclass(frozen=True)
class _Velocity:
    """Where in a row the velocities are."""

    feature: str
    linear: int
    angular: int
    sideways: int | None
    metres: float
    radians: float


@dataclass(frozen=True)
class _Episode:
    """Where an episode is."""

    number: int
    length: int
    data: str
    video: str | None
    begin_s: float


@dataclass(frozen=True)
class _Set:
    """What the description says that holds for all episodes."""

    inside: Inside
    layout: str
    fps: float
    chunk: int
    camera: str
    is_video: bool
    velocity: _Velocity
    pose: list[int] | None


def read(inside: Inside, wishes: Wishes, tally: Tally) -> Source:
    """Read a data set; each of its episodes is a drive."""
    called = inside.called(INFO)
    info = parsed(inside.read(INFO), called)
    try:
        version, features = str(info["codebase_version"]), dict(info["features"])
        fps, chunk = float(info["fps"]), int(info.get("chunks_size", 1000))
        described = {str(key): dict(feature) for key, feature in features.items()}
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
        raise ImportFailure(f"{called}: lacks codebase_version, fps or features") from None
    layout = version.partition(".")[0]
    if version not in ("v2.0", "v2.1", "v3.0"):
        raise ImportFailure(f"{called}: version {printable(version)}; v2.0, v2.1 and v3.0 are read")
    if not 1.0 <= fps <= 1000.0 or chunk < 1:
        raise ImportFailure(f"{called}: {fps:g} frames a second and chunks of {chunk} are not those of a camera")
    camera = _camera(described, wishes, called)
    velocity = _velocity(described, wishes, called)
    state = _names(described.get(STATE, {}))
    pose = [state.index(name) for name in POSE] if set(POSE) <= set(state) else None
    dataset = _Set(inside, layout, fps, chunk, camera, described[camera]["dtype"] == "video", velocity, pose)
    drives = [
        _drive(dataset, episode, tally)
        for episode in _episodes(dataset)
        if not wishes.episodes or str(episode.number) in wishes.episodes
    ]
    announced = info.get("total_episodes")
    if not wishes.episodes and announced != len(drives):
        tally.say(f"meta/info.json announces {printable(str(announced))} episodes, there are {len(drives)}")
    return Source(drives, metric=True)


def _camera(features: dict[str, dict[str, Any]], wishes: Wishes, called: str) -> str:
    cameras = [key for key, feature in features.items() if feature.get("dtype") in ("video", "image")]
    named = ", ".join(map(printable, cameras)) or "none"
    if wishes.camera is not None:
        if wishes.camera not in cameras:
            raise ImportFailure(f"{called}: no camera {wishes.camera}; there are: {named}")
        return wishes.camera
    if len(cameras) != 1:
        raise ImportFailure(f"{called}: {len(cameras)} cameras ({named}); choose one with --camera")
    return cameras[0]


def _velocity(features: dict[str, dict[str, Any]], wishes: Wishes, called: str) -> _Velocity:
    asked = None if wishes.velocity is None else tuple(map(_plain, wishes.velocity.split(",")))
    known = _NAMES if asked is None else {asked: _NAMES.get(asked, 1.0)}  # type: ignore[arg-type]
    seen: list[str] = []
    for feature in _FEATURES:
        names = [_plain(name) for name in _names(features.get(feature, {}))]
        seen += names
        for wanted, radians in known.items():
            if len(wanted) == 2 and set(wanted) <= set(names):
                linear, angular = (names.index(name) for name in wanted)
                sideways = next((names.index(name) for name in _SIDEWAYS if name in names), None)
                return _Velocity(feature, linear, angular, sideways, wishes.speed or 1.0, wishes.turn_rate or radians)
    named = ", ".join(map(printable, dict.fromkeys(seen))) or "no names"
    raise ImportFailure(
        f"{called}: neither action nor observation.state has a linear and an angular velocity of a base "
        f"({named[:300]}); name them with --velocity LINEAR,ANGULAR"
    )


def _plain(name: str) -> str:
    return re.sub(r"[.\s/_]+", "_", name.strip().lower())


def _names(feature: dict[str, Any]) -> list[str]:
    names = feature.get("names")
    if isinstance(names, dict) and len(names) == 1:
        (names,) = names.values()
    return [str(name) for name in names] if isinstance(names, list) else []


def _episodes(dataset: _Set) -> Iterator[_Episode]:
    found = _episodes_of_lines(dataset) if dataset.layout == "v2" else _episodes_of_tables(dataset)
    for count, episode in enumerate(found):
        if count >= _MOST_EPISODES:
            raise ImportFailure(f"{dataset.inside.path}: more than {_MOST_EPISODES} episodes")
        yield episode


def _episodes_of_lines(dataset: _Set) -> Iterator[_Episode]:
    called = dataset.inside.called("meta/episodes.jsonl")
    data, video = _V2
    for line in dataset.inside.lines("meta/episodes.jsonl"):
        values = parsed(line, called)
        try:
            number, length = int(values["episode_index"]), int(values["length"])
            at = (number // dataset.chunk, number, dataset.camera)
            yield _Episode(number, length, data.format(*at), video.format(*at) if dataset.is_video else None, 0.0)
        except (KeyError, TypeError, ValueError, OverflowError):
            raise ImportFailure(f"{called}: a line lacks episode_index or length") from None


def _episodes_of_tables(dataset: _Set) -> Iterator[_Episode]:
    key = f"videos/{dataset.camera}/"
    columns = ["episode_index", "length", "data/chunk_index", "data/file_index"]
    if dataset.is_video:
        columns += [f"{key}chunk_index", f"{key}file_index", f"{key}from_timestamp"]
    for name in _tables(dataset.inside):
        for batch in batches(dataset.inside, name, columns):
            each = [numbers(batch, column, dataset.inside.called(name)) for column in columns]
            if any(column.ndim != 1 or not np.isfinite(column).all() or (column < 0).any() for column in each):
                raise ImportFailure(f"{dataset.inside.called(name)}: not numbers from 0 on")
            for number, length, chunk, file, *of_video in zip(*(column.tolist() for column in each), strict=True):
                video, begin_s = None, 0.0
                if of_video:
                    at = {"chunk_index": int(of_video[0]), "file_index": int(of_video[1])}
                    video, begin_s = VIDEO.format(video_key=dataset.camera, **at), of_video[2]
                data = DATA.format(chunk_index=int(chunk), file_index=int(file))
                yield _Episode(int(number), int(length), data, video, begin_s)


def _tables(inside: Inside) -> list[str]:
    chunks = [f"{EPISODES}/{chunk}" for chunk in inside.names(EPISODES)]
    found = [f"{chunk}/{name}" for chunk in chunks for name in inside.names(chunk)]
    tables = [name for name in found if name.endswith(".parquet")]
    if not tables:
        raise ImportFailure(f"{inside.called(EPISODES)}: has no chunk-000/file-000.parquet")
    return tables


def _drive(dataset: _Set, episode: _Episode, tally: Tally) -> Drive:
    called = dataset.inside.called(episode.data)
    velocity = dataset.velocity
    found: dict[str, list[Array]] = {"timestamp": [], velocity.feature: [], SUCCESS: []}
    if dataset.pose is not None:
        found[STATE] = []
    for batch in batches(dataset.inside, episode.data, ["episode_index", *found]):
        mine = numbers(batch, "episode_index", called) == episode.number
        for column, parts in found.items():
            if column != SUCCESS or SUCCESS in batch.schema.names:
                parts.append(numbers(batch, column, called)[mine])
    times_s = np.concatenate([np.zeros(0), *(part.reshape(-1) for part in found["timestamp"])])
    name = f"episode {episode.number}"
    if times_s.size != episode.length:
        tally.say(f"{name}: announces {episode.length} frames, has {times_s.size}")
    motion = _motion(times_s, found[velocity.feature], velocity, called, tally)
    success = bool(np.concatenate(found[SUCCESS]).any()) if found[SUCCESS] else None
    frames = partial(_video_frames, dataset, episode, times_s) if episode.video else None
    return Drive(
        str(episode.number),
        motion,
        frames or partial(_embedded_frames, dataset, episode),
        times_s.size,
        None if dataset.pose is None else _track(times_s, found[STATE], dataset.pose, called, tally),
        success=success,
    )


def _motion(times_s: Array, rows: list[Array], velocity: _Velocity, called: str, tally: Tally) -> Motion:
    if not times_s.size:
        return Motion.of([], tally)
    values = _joined(rows, velocity.feature, max(velocity.linear, velocity.angular, velocity.sideways or 0), called)
    if velocity.sideways is not None:
        aside = np.abs(values[:, velocity.sideways]) > _LEAST_SIDEWAYS
        tally.count("frames go sideways, for which there is no atom", int(aside.sum()))
    linear, angular = velocity.metres * values[:, velocity.linear], velocity.radians * values[:, velocity.angular]
    return Motion.of(list(zip(times_s.tolist(), linear.tolist(), angular.tolist(), strict=True)), tally)


def _track(times_s: Array, rows: list[Array], pose: list[int], called: str, tally: Tally) -> Track | None:
    if not times_s.size:
        return None
    poses = _joined(rows, STATE, max(pose), called)[:, pose]
    return Track.of([(time_s, x, y, heading) for time_s, (x, y, heading) in zip(times_s, poses, strict=True)], tally)


def _joined(rows: list[Array], feature: str, last: int, called: str) -> Array:
    """Return rows (n, width) that have a number at the place that is to be the last."""
    if any(part.ndim != 2 or part.shape[1] != rows[0].shape[1] for part in rows):
        raise ImportFailure(f"{called}: the rows of {feature} are not equally long")
    values = np.concatenate(rows)
    if values.shape[1] <= last:
        raise ImportFailure(f"{called}: {feature} has fewer numbers than {INFO} names")
    return values


def _video_frames(dataset: _Set, episode: _Episode, times_s: Array) -> Iterator[Frame]:
    assert episode.video is not None  # noqa: S101 - or this would not be asked
    if not times_s.size:
        return
    called = dataset.inside.called(episode.video)
    with dataset.inside.open(episode.video) as file:
        found = frames_at(file, called, episode.begin_s + times_s, 0.5 / dataset.fps)
        for time_s, frame in zip(times_s.tolist(), found, strict=True):
            yield Frame(time_s, partial(jpeg_of, frame))


def _embedded_frames(dataset: _Set, episode: _Episode) -> Iterator[Frame]:
    called = dataset.inside.called(episode.data)
    for batch in batches(dataset.inside, episode.data, ["episode_index", "timestamp", dataset.camera], IMAGES):
        mine = numbers(batch, "episode_index", called) == episode.number
        times_s = numbers(batch, "timestamp", called).reshape(-1)
        if dataset.camera not in batch.schema.names:
            raise ImportFailure(f"{called}: lacks the column {printable(dataset.camera)}")
        for row in np.flatnonzero(mine).tolist():
            yield Frame(float(times_s[row]), partial(_embedded, batch.column(dataset.camera)[row]))


def _embedded(cell: Any) -> bytes:  # noqa: ANN401 - of a package without types
    value = cell.as_py()
    data = value.get("bytes") if isinstance(value, dict) else value
    if not isinstance(data, bytes):
        raise NotAnImage("images are not in the Parquet file")
    return as_jpeg(data)
