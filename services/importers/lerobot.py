"""LeRobotDataset, versions 2.0, 2.1 and 3.0, of wheeled bases: Parquet and MP4."""

import math
import re
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Annotated, Any, Final, Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, BeforeValidator, Field, JsonValue, NonNegativeInt, PositiveInt

from schemas.codec import printable
from services.importers.drive import (
    MOST_SAMPLES,
    POSE,
    Array,
    Image,
    ImportedDrive,
    ImportFailure,
    NotAnImage,
    Reads,
    Tally,
)
from services.importers.images import as_jpeg
from services.importers.inside import Inside
from services.importers.job import ImportJob, choose
from services.importers.ticks import LEAST_LINEAR
from services.importers.videos import frames_at
from services.kit.pixels import BitDepth

#: Metres and radians per second, and the pose by odometry, in our own data sets.
VELOCITIES: Final = ("linear_velocity", "angular_velocity")
ACTION = "action"
STATE = "observation.state"
SUCCESS = "next.success"
#: Last parts of the names of velocities, the usual ones first.
_LINEAR: Final = (
    "x_vel", "linear_velocity", "linear_vel", "linear_x", "linear", "vx", "vel_x",
)  # fmt: skip
_ANGULAR: Final = (
    "theta_vel", "angular_velocity", "angular_vel", "angular_z", "angular", "wz", "omega",
    "yaw_rate", "yaw_vel", "vel_theta", "vyaw",
)  # fmt: skip
_SEEN: Final = ("video", "image")  # Types of features.
_SIDEWAYS: Final = ("y_vel", "linear_y", "vy", "vel_y")
_DEGREES: Final = "theta_vel"  # Turn rate of LeKiwi, degrees a second.
_LINES: Final = "meta/episodes.jsonl"  # Files of version 2.
_DATA_V2: Final = "data/chunk-{0:03d}/episode_{1:06d}.parquet"
_VIDEO_V2: Final = "videos/chunk-{0:03d}/{2}/episode_{1:06d}.mp4"
INFO: Final = "meta/info.json"  # Files of version 3.0.
EPISODES: Final = "meta/episodes"
DATA: Final = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO: Final = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
_EPISODE: Final = "episode_index"
#: Columns that describe an episode.
_ROW: Final = (_EPISODE, "length", "data/chunk_index", "data/file_index")
# Rows of numbers, and of images, per read.
_ROWS = 4096
_IMAGES = 16
#: Limits of a Parquet file's metadata, bytes and entries; ten million rows have 100,000.
_LIMITS: Final = {"thrift_string_size_limit": 64 * 2**20, "thrift_container_size_limit": 10_000_000}


def _names(names: JsonValue) -> list[str]:
    """Return the names of a feature's numbers: nested lists or maps of names, or map to numbers."""
    if isinstance(names, dict):
        indexed = all(isinstance(one, int) for one in names.values())
        return _names(list(names) if indexed else list(names.values()))
    if isinstance(names, list):
        return [name for one in names for name in _names(one)]
    return [] if names is None else [str(names)]


class _Feature(BaseModel):
    dtype: JsonValue = None
    names: Annotated[list[str], BeforeValidator(_names)] = []


class _Info(BaseModel):
    """Metadata common to all episodes."""

    codebase_version: Literal["v2.0", "v2.1", "v3.0"]
    fps: Annotated[float, Field(ge=1.0, le=1000.0)]
    chunks_size: PositiveInt = 1000
    total_episodes: JsonValue = None
    features: dict[str, _Feature]

    def names(self, feature: str) -> list[str]:
        """Return the names of a feature's numbers; [] if there is no such feature."""
        return self.features[feature].names if feature in self.features else []


class _Line(BaseModel):
    """An episode of version 2."""

    episode_index: NonNegativeInt
    length: int


class _Episode(NamedTuple):
    """The files of an episode; without a video its images are in the data."""

    number: int
    length: int
    data: str
    video: str = ""
    begin_s: float = 0.0


class _Velocity(NamedTuple):
    """The columns of the velocities in a feature, and their units in metres and radians a second."""

    feature: str
    linear: int
    angular: int
    sideways: int | None
    metres: float
    radians: float


def found(inside: Inside) -> bool:
    """Return whether a folder is a data set."""
    return INFO.rpartition("/")[2] in inside.names(INFO.rpartition("/")[0])


def read(inside: Inside, job: ImportJob, tally: Tally) -> Reads:
    """Return the reads of the episodes of a data set; each is a drive."""
    job.check_used("a LeRobotDataset", "camera", "velocity", "speed", "turn_rate")
    dataset = _DataSet(inside, job, tally)
    every = list(dataset.episodes())
    reads = {str(episode.number): partial(dataset.drives, episode) for episode in every}
    tally.count("episodes are described again (read once)", len(every) - len(reads))
    announced = dataset.info.total_episodes
    if announced != len(reads):
        tally.say(f"{INFO} announces {printable(str(announced))} episodes, there are {len(reads)}")
    return dict(reads)


class _DataSet:
    def __init__(self, inside: Inside, job: ImportJob, tally: Tally) -> None:
        self._inside = inside
        self._tally = tally
        self._depth = BitDepth()
        self.info = inside.parsed(_Info, inside.read(INFO), INFO)
        self._camera = _camera(self.info, job, inside.called(INFO))
        self._velocity = _velocity(self.info, job, inside.called(INFO))
        state = self.info.names(STATE)
        self._pose = [state.index(name) for name in POSE] if set(POSE) <= set(state) else []
        self._filmed = self.info.features[self._camera].dtype == "video"

    def episodes(self) -> Iterator[_Episode]:
        return self._of_tables() if self.info.codebase_version == "v3.0" else self._of_lines()

    def _of_lines(self) -> Iterator[_Episode]:
        for line in self._inside.lines(_LINES):
            entry = self._inside.parsed(_Line, line, _LINES)
            at = entry.episode_index // self.info.chunks_size, entry.episode_index, self._camera
            video = _VIDEO_V2.format(*at) if self._filmed else ""
            yield _Episode(entry.episode_index, entry.length, _DATA_V2.format(*at), video)

    def _of_tables(self) -> Iterator[_Episode]:
        for name in self._tables():
            columns = _numbers(self._inside, name, [*_ROW, *self._film_columns()])
            counts = (
                each.ndim == 1 and ((each >= 0.0) & (each < np.inf)).all() for each in columns
            )
            if not all(counts):
                raise ImportFailure(
                    f"{self._inside.called(name)}: episodes are not numbered from 0"
                )
            yield from map(self._episode_of, zip(*map(np.ndarray.tolist, columns), strict=True))

    def _tables(self) -> list[str]:
        """Return the files with the metadata of episodes."""
        chunks = [f"{EPISODES}/{chunk}" for chunk in self._inside.names(EPISODES)]
        files = [f"{chunk}/{name}" for chunk in chunks for name in self._inside.names(chunk)]
        if not files:
            called = self._inside.called(EPISODES)
            raise ImportFailure(f"{called}: chunk-000/file-000.parquet not found")
        return files

    def _film_columns(self) -> list[str]:
        names = ("chunk_index", "file_index", "from_timestamp") if self._filmed else ()
        return [f"videos/{self._camera}/{name}" for name in names]

    def _episode_of(self, row: tuple[float, ...]) -> _Episode:
        number, length, chunk, file, *film = row
        data = DATA.format(chunk_index=int(chunk), file_index=int(file))
        if not film:
            return _Episode(int(number), int(length), data)
        film_chunk, film_file, begin_s = film
        video = VIDEO.format(
            video_key=self._camera, chunk_index=int(film_chunk), file_index=int(film_file)
        )
        return _Episode(int(number), int(length), data, video, begin_s)

    def drives(self, episode: _Episode) -> list[ImportedDrive]:
        where = self._velocity
        found = self._columns_of(episode)
        times_s = found["timestamp"].ravel()
        if times_s.size != episode.length:
            announced = f"announces {episode.length} frames, has {times_s.size}"
            self._tally.say(f"episode {episode.number}: {announced}")
        sideways = [] if where.sideways is None else [where.sideways]
        moved = self._part(
            episode, found[where.feature], where.feature, [where.linear, where.angular, *sideways]
        )
        aside = np.abs(moved[:, 2:]) > LEAST_LINEAR
        self._tally.count("frames go sideways, without a matching action", int(aside.sum()))
        track = np.zeros((0, 1 + len(POSE)))
        if self._pose:
            poses = self._part(episode, found[STATE], STATE, self._pose)
            track = np.column_stack([times_s[: len(poses)], poses])
        drive = ImportedDrive.of_rows(
            str(episode.number),
            times_s,
            partial(self._video if episode.video else self._embedded, episode, times_s),
            np.column_stack([times_s, moved[:, :2] * (where.metres, where.radians)]),
            track,
            self._tally,
            success=bool(found[SUCCESS].any()) if SUCCESS in found else None,
            turn_rate=where.radians,
        )
        return [drive]

    def _columns_of(self, episode: _Episode) -> dict[str, Array]:
        """Return the rows of an episode by the features that are read."""
        wanted = ["timestamp", self._velocity.feature]
        wanted += [STATE] if self._pose else []
        wanted += [SUCCESS] if SUCCESS in self.info.features else []
        columns = list(dict.fromkeys(wanted))
        rows = _numbers(self._inside, episode.data, columns, episode.number)
        return dict(zip(columns, rows, strict=True))

    def _part(self, episode: _Episode, rows: Array, feature: str, at: list[int]) -> Array:
        """Return some numbers of the rows of a feature, (n, m)."""
        if not rows.size:
            return np.zeros((0, len(at)))
        if rows.ndim != 2 or rows.shape[1] <= max(at):
            called = self._inside.called(episode.data)
            raise ImportFailure(f"{called}: {feature} has fewer numbers than {INFO} announces")
        return rows[:, at]

    def _video(self, episode: _Episode, times_s: Array) -> Iterator[Image]:
        if times_s.size:
            with self._inside.open(episode.video) as file:
                called = self._inside.called(episode.video)
                tolerance_s = 0.5 / self.info.fps
                yield from frames_at(file, called, episode.begin_s + times_s, tolerance_s)

    def _embedded(self, episode: _Episode, _times_s: Array) -> Iterator[Image]:
        for batch in _batches(self._inside, episode.data, [self._camera], episode.number, _IMAGES):
            yield from (
                partial(_cell, cell, self._tally, self._depth)
                for cell in batch.column(self._camera)
            )


def _camera(info: _Info, job: ImportJob, called: str) -> str:
    cameras = [key for key, feature in info.features.items() if feature.dtype in _SEEN]
    return choose(f"{called}: camera", job.camera, cameras, cameras, "--camera")


def _velocity(info: _Info, job: ImportJob, called: str) -> _Velocity:
    # The command describes the driver better than the movement that follows.
    numbers = [key for key, feature in info.features.items() if feature.dtype not in _SEEN]
    for feature in sorted(numbers, key=lambda key: (key != ACTION, key != STATE)):
        names = [_plain(name) for name in info.names(feature)]
        linear, angular = _pair(names, job.velocity)
        if linear is None or angular is None:
            continue
        degrees = any(name.endswith(_DEGREES) for name in names[angular : angular + 1])
        radians = math.radians(1.0) if degrees else 1.0
        return _Velocity(
            feature,
            linear,
            angular,
            _index(names, _SIDEWAYS),
            *job.scale(radians),
        )
    named = (f"{key}: {', '.join(info.names(key)) or 'no names'}" for key in numbers)
    raise ImportFailure(
        f"{called}: no linear and angular velocity of a base in {printable('; '.join(named))[:300]};"
        " name them with --velocity LINEAR,ANGULAR, or number them: --velocity 0,1"
    )


def _pair(names: list[str], asked: str | None) -> tuple[int | None, int | None]:
    """Return the indexes of the linear and the angular velocity in the names of a feature."""
    if asked is None:
        return _index(names, _LINEAR), _index(names, _ANGULAR)
    linear, _, angular = asked.partition(",")
    return _asked(names, linear), _asked(names, angular)


def _index(names: list[str], endings: Sequence[str]) -> int | None:
    """Return the index of the only name that ends so; the first ending that fits decides."""
    for ending in endings:
        found = [index for index, name in enumerate(names) if f"_{name}".endswith(f"_{ending}")]
        if found:
            return found[0] if len(found) == 1 else None
    return None


def _asked(names: list[str], name: str) -> int | None:
    """Return the index of a requested name; a number is the index itself."""
    if name.strip().isdecimal():
        return int(name)
    return names.index(_plain(name)) if _plain(name) in names else None


def _plain(name: str) -> str:
    return re.sub(r"[.\s/_]+", "_", name.strip().lower())


def _cell(cell: Any, tally: Tally, depth: BitDepth) -> bytes:  # noqa: ANN401 - of a package without types
    value = cell.as_py()
    data = value.get("bytes") if isinstance(value, dict) else value
    if not isinstance(data, bytes):
        raise NotAnImage("images are not in the Parquet file")
    return as_jpeg(data, tally, depth)


def _batches(
    inside: Inside, name: str, columns: Sequence[str], episode: int | None = None, rows: int = _ROWS
) -> Iterator[Any]:
    import pyarrow as pa  # noqa: PLC0415 - of the extra `formats`
    import pyarrow.compute as pc  # noqa: PLC0415
    import pyarrow.parquet as pq  # noqa: PLC0415

    called = inside.called(name)
    wanted = list(dict.fromkeys([_EPISODE, *columns]))
    try:
        with inside.open(name) as file:
            table = pq.ParquetFile(file, **_LIMITS)
            if table.metadata.num_rows > MOST_SAMPLES:
                raise ImportFailure(f"{called}: too large (more than {MOST_SAMPLES} rows)")
            if missing := [column for column in wanted if column not in table.schema_arrow.names]:
                raise ImportFailure(f"{called}: lacks the column {printable(missing[0])}")
            for batch in table.iter_batches(batch_size=rows, columns=wanted, use_threads=False):
                yield (
                    batch
                    if episode is None
                    else batch.filter(pc.equal(batch.column(_EPISODE), episode))
                )
    except (pa.ArrowException, OSError, ValueError, MemoryError) as error:
        raise ImportFailure(
            f"{called}: not a readable Parquet file: {printable(str(error))}"
        ) from None


def _numbers(
    inside: Inside, name: str, columns: Sequence[str], episode: int | None = None
) -> list[Array]:
    """Return columns of numbers: (n,), or of lists of equal length, (n, width)."""
    batches = [
        [_cells(batch, column, inside.called(name)) for column in columns]
        for batch in _batches(inside, name, columns, episode)
        if batch.num_rows
    ]
    if not batches:
        return [np.zeros(0) for _ in columns]
    parts = list(zip(*batches, strict=True))
    for column, found in zip(columns, parts, strict=True):
        if len({part.shape[1:] for part in found}) > 1:
            raise _not_numbers(column, inside.called(name))
    return [np.concatenate(found) for found in parts]


def _cells(batch: Any, column: str, called: str) -> Array:  # noqa: ANN401 - as above
    try:
        return np.array(batch.column(column).to_pylist(), dtype=np.float64)
    except (ValueError, TypeError, OverflowError):
        raise _not_numbers(column, called) from None


def _not_numbers(column: str, called: str) -> ImportFailure:
    wrong = "is not a column of numbers, or its rows differ in length"
    return ImportFailure(f"{called}: {printable(column)} {wrong}")
