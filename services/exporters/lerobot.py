"""LeRobotDataset v3.0, as lerobot 0.4 reads it: rows as Parquet, images as MP4, and what describes them.

Its frames are a tenth of a second apart, without exception: where a tick is missing an episode ends and another begins.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.exporters.drives import Drive, ExportFailure, Moment, say_view
from services.exporters.statistics import Statistics, histogram, of_images, of_numbers
from services.exporters.video import CODEC, PIXELS, Videos
from services.importers.drive import Tally
from services.importers.lerobot import ACTION, DATA, EPISODES, INFO, POSE, STATE, SUCCESS, VELOCITIES, VIDEO
from services.importers.resample import TICK_S
from services.kit.jpeg import decode_jpeg

CAMERA: Final = "observation.images.front"
FPS: Final = round(1.0 / TICK_S)
#: The format's own: files in a folder, and from which size on, in megabytes, another file begins.
_CHUNK, _DATA_MB, _VIDEO_MB = 1000, 100, 200
_FIRST: Final = {"chunk_index": 0, "file_index": 0}


class _Frame(NamedTuple):
    """A row, without what its place in the table says."""

    action: tuple[float, float]
    pose: tuple[float, float, float] | None
    success: bool


@dataclass
class _Episode:
    """A piece of a drive without gaps."""

    task: str
    video: dict[str, int]
    begin: int
    frames: list[_Frame] = field(default_factory=list)
    counts: NDArray[np.int64] = field(default_factory=lambda: np.zeros((3, 256), np.int64))


def write(drives: Sequence[Drive], folder: Path, tally: Tally, advance: Callable[[], None]) -> None:
    """Write one data set of all drives."""
    import av  # noqa: PLC0415 - of the extra `formats`

    try:
        with closing(Videos(folder, VIDEO, CAMERA, FPS, _CHUNK, _VIDEO_MB)) as videos:
            episodes = list(_filmed(drives, videos, tally, advance))
    except av.FFmpegError as error:
        raise ExportFailure(f"the video cannot be written: {error.strerror or type(error).__name__}") from None
    say_view(drives, tally)
    if not episodes:
        raise ExportFailure("nothing to export: no frame has an image and tells what was done then")
    _Tables(folder, episodes, tally).write(videos, drives[0].episode.robot)


def _filmed(drives: Sequence[Drive], videos: Videos, tally: Tally, advance: Callable[[], None]) -> Iterator[_Episode]:
    for drive in drives:
        episode, last = None, -1
        for moment in drive.moments(tally):
            advance()
            pixels = _pixels(moment, videos, tally)
            if pixels is None or moment.velocity is None:
                continue
            if episode is None or moment.tick != last + 1:
                if episode is not None:
                    tally.count("gaps are the end of an episode and the beginning of another")
                at, begin = videos.begin_episode(pixels)
                episode = _Episode(f"Go to the {drive.episode.goal}.", at, begin)
                yield episode
            last = moment.tick
            videos.add(pixels)
            episode.counts += histogram(pixels)
            pose = moment.pose
            way = None if pose is None else (pose.x_m, pose.y_m, pose.heading_rad)
            arrived = drive.success and moment.tick == drive.episode.end_tick
            episode.frames.append(_Frame(moment.velocity, way, arrived))


def _pixels(moment: Moment, videos: Videos, tally: Tally) -> NDArray[np.uint8] | None:
    """Return the image of a tick that can be in the data set."""
    if moment.jpeg is None:
        return None
    if moment.velocity is None:
        tally.count("frames do not tell what was done then, and are left out")
        return None
    try:
        pixels = decode_jpeg(moment.jpeg)
    except ValueError:
        tally.count("images are damaged")
        return None
    if videos.size not in (None, pixels.shape[1::-1]):
        tally.count("images have another size than the first, and are left out")
        return None
    return pixels


class _Tables:
    """Writes everything but the images."""

    def __init__(self, folder: Path, episodes: list[_Episode], tally: Tally) -> None:
        self._folder = folder
        self._episodes = episodes
        lengths = [len(episode.frames) for episode in episodes]
        self._ends = np.cumsum(lengths).tolist()
        frames = [frame for episode in episodes for frame in episode.frames]
        places = np.concatenate([np.arange(length) for length in lengths])
        self._tasks = list(dict.fromkeys(episode.task for episode in episodes))
        tasks = [self._tasks.index(episode.task) for episode in episodes]
        #: By feature, as the rows have them.
        self._columns: dict[str, NDArray[Any]] = {ACTION: np.array([frame.action for frame in frames], np.float32)}
        poses = [frame.pose for frame in frames if frame.pose is not None]
        if len(poses) == len(frames):
            self._columns[STATE] = np.array(poses, np.float32)
        else:
            tally.say(f"{len(frames) - len(poses)} of {len(frames)} frames lack odometry: there is no {STATE}")
        self._columns |= {
            SUCCESS: np.array([frame.success for frame in frames]),
            "timestamp": (places / FPS).astype(np.float32),
            "frame_index": places,
            "episode_index": np.repeat(np.arange(len(episodes)), lengths),
            "index": np.arange(len(frames)),
            "task_index": np.repeat(tasks, lengths),
        }

    def write(self, videos: Videos, robot: str) -> None:
        """Write data and description."""
        self._rows()
        self._described()
        self._named_tasks()
        images = sum(episode.counts for episode in self._episodes)
        everything = {CAMERA: of_images(np.asarray(images), self._ends[-1]), **self._statistics(slice(None))}
        self._json("meta/stats.json", everything)
        self._json(INFO, self._info(videos, robot))

    def _rows(self) -> None:
        import pyarrow as pa  # noqa: PLC0415 - of the extra `formats`
        import pyarrow.parquet as pq  # noqa: PLC0415

        arrays = {name: _arrow(values) for name, values in self._columns.items()}
        table = pa.table(arrays)
        with pq.ParquetWriter(self._path(DATA), table.schema) as writer:
            for begin, end in zip([0, *self._ends], self._ends, strict=False):
                writer.write_table(table.slice(begin, end - begin))

    def _described(self) -> None:
        rows = []
        for number, (episode, end) in enumerate(zip(self._episodes, self._ends, strict=True)):
            length = len(episode.frames)
            statistics = {CAMERA: of_images(episode.counts, length), **self._statistics(slice(end - length, end))}
            row: dict[str, Any] = {"episode_index": number, "tasks": [episode.task], "length": length}
            row |= {f"data/{name}": index for name, index in _FIRST.items()}
            row |= {"dataset_from_index": end - length, "dataset_to_index": end}
            row |= {f"videos/{CAMERA}/{name}": index for name, index in episode.video.items()}
            row[f"videos/{CAMERA}/from_timestamp"] = episode.begin / FPS
            row[f"videos/{CAMERA}/to_timestamp"] = (episode.begin + length) / FPS
            row |= {f"stats/{key}/{name}": value for key, one in statistics.items() for name, value in one.items()}
            row |= {f"meta/episodes/{name}": index for name, index in _FIRST.items()}
            rows.append(row)
        self._parquet(f"{EPISODES}/chunk-{{chunk_index:03d}}/file-{{file_index:03d}}.parquet", rows, None)

    def _named_tasks(self) -> None:
        # Others read this table with pandas, and look tasks up in its index.
        column = {"pandas_type": "unicode", "numpy_type": "object", "metadata": None}
        number = {"pandas_type": "int64", "numpy_type": "int64", "metadata": None}
        described = {
            "index_columns": ["task"],
            "column_indexes": [{"name": None, "field_name": None, **column, "metadata": {"encoding": "UTF-8"}}],
            "columns": [
                {"name": "task_index", "field_name": "task_index", **number},
                {"name": "task", "field_name": "task", **column},
            ],
            "creator": {"library": "smal", "version": "0"},
            "pandas_version": "2.0.0",
        }
        rows = [{"task_index": number, "task": task} for number, task in enumerate(self._tasks)]
        self._parquet("meta/tasks.parquet", rows, {"pandas": json.dumps(described)})

    def _info(self, videos: Videos, robot: str) -> dict[str, Any]:
        assert videos.size is not None  # noqa: S101 - there are images
        width, height = videos.size
        film = {
            "video.height": height, "video.width": width, "video.codec": CODEC, "video.pix_fmt": PIXELS,
            "video.is_depth_map": False, "video.fps": FPS, "video.channels": 3, "has_audio": False,
        }  # fmt: skip
        names = {ACTION: list(VELOCITIES), STATE: list(POSE)}
        rows = {
            key: {"dtype": str(values.dtype), "shape": list(values.shape[1:]) or [1], "names": names.get(key)}
            for key, values in self._columns.items()
        }
        shown = {"dtype": "video", "shape": [height, width, 3], "names": ["height", "width", "channels"], "info": film}
        return {
            "codebase_version": "v3.0", "robot_type": robot, "total_episodes": len(self._episodes),
            "total_frames": self._ends[-1], "total_tasks": len(self._tasks), "chunks_size": _CHUNK,
            "data_files_size_in_mb": _DATA_MB, "video_files_size_in_mb": _VIDEO_MB, "fps": FPS,
            "splits": {"train": f"0:{len(self._episodes)}"}, "data_path": DATA, "video_path": VIDEO,
            "features": {CAMERA: shown, **rows},
        }  # fmt: skip

    def _statistics(self, rows: slice) -> dict[str, Statistics]:
        each = {key: values[rows] for key, values in self._columns.items()}
        return {key: of_numbers(values.reshape(len(values), -1)) for key, values in each.items()}

    def _parquet(self, name: str, rows: list[dict[str, Any]], metadata: dict[str, str] | None) -> None:
        import pyarrow as pa  # noqa: PLC0415 - as above
        import pyarrow.parquet as pq  # noqa: PLC0415

        pq.write_table(pa.Table.from_pylist(rows).replace_schema_metadata(metadata), self._path(name))

    def _json(self, name: str, content: dict[str, Any]) -> None:
        self._path(name).write_text(json.dumps(content, indent=4) + "\n", encoding="utf-8")

    def _path(self, name: str) -> Path:
        path = self._folder / name.format(**_FIRST)
        path.parent.mkdir(parents=True, exist_ok=True)
        return path


def _arrow(values: NDArray[Any]) -> Any:  # noqa: ANN401 - of a package without types
    """Return a column, of which a cell is a number or a list of as many numbers each."""
    import pyarrow as pa  # noqa: PLC0415 - as above

    flat = pa.array(values.ravel())
    return flat if values.ndim == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
