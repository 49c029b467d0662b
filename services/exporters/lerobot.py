"""LeRobotDataset v3.0, as lerobot 0.4 reads it: a missing tick ends an episode."""

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import chain, count, groupby
from operator import itemgetter
from pathlib import Path
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.base import TICK_S
from schemas.motion import Odometry
from services.exporters.drives import ExportedDrive, Moment, say_view
from services.importers.drive import POSE, Tally
from services.importers.lerobot import (
    ACTION,
    DATA,
    EPISODES,
    INFO,
    STATE,
    SUCCESS,
    VELOCITIES,
    VIDEO,
)
from services.kit.errors import JobError
from services.kit.jpeg import decode_jpeg

CAMERA: Final = "observation.images.front"
FPS: Final = round(1.0 / TICK_S)
# Values of the format: files per folder, and megabytes per file.
_CHUNK = 1000
_DATA_MB = 100
_VIDEO_MB = 200
_FIRST: Final = {"chunk_index": 0, "file_index": 0}
#: Codec of lerobot for random access: every other image is a key frame. The quality is visually
#: lossless.
_CODEC = "h264"
_PIXELS = "yuv420p"
_OPTIONS = {"crf": "18", "g": "2", "bf": "0"}
_QUANTILES: Final = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
_NAME: Final = {"pandas_type": "unicode", "numpy_type": "object", "metadata": None}
_NUMBER: Final = {"pandas_type": "int64", "numpy_type": "int64", "metadata": None}
#: Schema of the table of tasks, for pandas: its index holds the tasks.
_TASKS: Final = {
    "index_columns": ["task"],
    "column_indexes": [
        {"name": None, "field_name": None, **_NAME, "metadata": {"encoding": "UTF-8"}}
    ],
    "columns": [
        {"name": "task_index", "field_name": "task_index", **_NUMBER},
        {"name": "task", "field_name": "task", **_NAME},
    ],
    "creator": {"library": "smal", "version": "0"},
    "pandas_version": "2.0.0",
}
Pixels = NDArray[np.uint8]
Statistics = dict[str, list[Any]]


class _Frame(NamedTuple):
    """A row of the table, without its indices."""

    action: tuple[float, float]
    odometry: Odometry | None
    success: bool


@dataclass
class _Episode:
    """A piece of a drive without gaps, and the histogram of its images by channel, (3, 256)."""

    task: str
    frames: list[_Frame] = field(default_factory=list)
    counts: NDArray[np.int64] = field(default_factory=lambda: np.zeros((3, 256), np.int64))

    def take(self, frame: _Frame, pixels: Pixels) -> None:
        self.frames.append(frame)
        counts = [
            cv2.calcHist([pixels], [channel], None, [256], [0.0, 256.0])[:, 0]
            for channel in range(3)
        ]
        self.counts += np.stack(counts).astype(np.int64)


def write(
    drives: Sequence[ExportedDrive], folder: Path, tally: Tally, advance: Callable[[], None]
) -> None:
    """Write one data set of all drives; each episode has a video of its own."""
    import av  # noqa: PLC0415 - of the extra `formats`

    episodes: list[_Episode] = []
    size = 0, 0
    try:
        for number, shown in groupby(_usable(drives, tally, advance), key=itemgetter(0)):
            first = next(shown)
            _, goal, _, pixels = first
            size = pixels.shape[1], pixels.shape[0]
            episodes.append(_Episode(f"Go to the {goal}."))
            with _video(folder / VIDEO.format(video_key=CAMERA, **_place(number)), size) as add:
                for _, _, frame, pixels in chain((first,), shown):
                    add(pixels)
                    episodes[-1].take(frame, pixels)
    except av.FFmpegError as error:
        raise JobError(
            f"the video cannot be written: {error.strerror or type(error).__name__}"
        ) from None
    say_view(drives, tally)
    if not episodes:
        raise JobError("nothing to export: no frame has both an image and an action")
    _describe(folder, episodes, size, drives[0].robot, tally)


def _place(episode: int) -> dict[str, int]:
    return {"chunk_index": episode // _CHUNK, "file_index": episode % _CHUNK}


def _usable(
    drives: Sequence[ExportedDrive], tally: Tally, advance: Callable[[], None]
) -> Iterator[tuple[int, str, _Frame, Pixels]]:
    """Yield the ticks of the data set: number of the episode, goal, row and image."""
    episode = -1
    last: tuple[ExportedDrive, int] | None = None
    for drive, moment, velocity, pixels in _of_one_size(drives, tally, advance):
        if last != (drive, moment.tick - 1):
            episode += 1
            is_gap = last is not None and last[0] == drive
            tally.count("gaps split an episode", int(is_gap))
        last = drive, moment.tick
        arrived = drive.success and moment.tick == drive.end_tick
        yield (
            episode,
            drive.goal,
            _Frame(velocity, moment.odometry, arrived),
            pixels,
        )


def _of_one_size(
    drives: Sequence[ExportedDrive], tally: Tally, advance: Callable[[], None]
) -> Iterator[tuple[ExportedDrive, Moment, tuple[float, float], Pixels]]:
    """Yield the moments whose image has the size of the first, with velocity and pixels."""
    size: tuple[int, ...] | None = None
    for drive in drives:
        for moment, jpeg, velocity in drive.usable(tally, advance):
            try:
                pixels = decode_jpeg(jpeg)
            except ValueError:
                tally.count("images are damaged")
                continue
            size = size or pixels.shape
            if pixels.shape == size:
                yield drive, moment, velocity, pixels
            else:
                tally.count("images differ in size from the first (left out)")


@contextmanager
def _video(path: Path, size: tuple[int, int]) -> Iterator[Callable[[Pixels], None]]:
    import av  # noqa: PLC0415 - as above

    width, height = size
    if width % 2 or height % 2:
        raise JobError(
            f"unsupported image size {width}x{height}: a video needs even numbers of columns "
            "and rows"
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=FPS, options=_OPTIONS)
        stream.width, stream.height = size
        stream.pix_fmt = _PIXELS
        number = count()

        def add(pixels: Pixels) -> None:
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
            frame.time_base = Fraction(1, FPS)
            frame.pts = next(number)
            container.mux(stream.encode(frame))

        yield add
        container.mux(stream.encode())


def _describe(
    folder: Path, episodes: list[_Episode], size: tuple[int, int], robot: str, tally: Tally
) -> None:
    import pyarrow as pa  # noqa: PLC0415 - of the extra `formats`

    lengths = [len(episode.frames) for episode in episodes]
    ends = np.cumsum(lengths).tolist()
    tasks = list(dict.fromkeys(episode.task for episode in episodes))
    columns = _columns(episodes, lengths, tasks, tally)
    _write_table(
        folder / DATA.format(**_FIRST),
        pa.table({name: _cells(values) for name, values in columns.items()}),
    )
    rows = []
    for number, (episode, length, end) in enumerate(zip(episodes, lengths, ends, strict=True)):
        film = f"videos/{CAMERA}"
        statistics = _statistics(columns, slice(end - length, end), [episode])
        row: dict[str, Any] = {"episode_index": number, "tasks": [episode.task], "length": length}
        row |= {f"data/{name}": index for name, index in _FIRST.items()}
        row |= {"dataset_from_index": end - length, "dataset_to_index": end}
        row |= {f"{film}/{name}": index for name, index in _place(number).items()}
        row |= {f"{film}/from_timestamp": 0.0, f"{film}/to_timestamp": length / FPS}
        row |= {
            f"stats/{key}/{name}": value
            for key, one in statistics.items()
            for name, value in one.items()
        }
        rows.append(row | {f"meta/episodes/{name}": index for name, index in _FIRST.items()})
    _write_table(folder / EPISODES / "chunk-000/file-000.parquet", pa.Table.from_pylist(rows))
    named = [{"task_index": number, "task": task} for number, task in enumerate(tasks)]
    _write_table(
        folder / "meta/tasks.parquet", pa.Table.from_pylist(named), {"pandas": json.dumps(_TASKS)}
    )
    _write_json(folder / "meta/stats.json", _statistics(columns, slice(None), episodes))
    _write_json(
        folder / INFO, _info(columns, len(episodes), len(tasks), size) | {"robot_type": robot}
    )


def _columns(
    episodes: list[_Episode], lengths: list[int], tasks: list[str], tally: Tally
) -> dict[str, NDArray[Any]]:
    frames = [frame for episode in episodes for frame in episode.frames]
    places = np.concatenate([np.arange(length) for length in lengths])
    columns: dict[str, NDArray[Any]] = {
        ACTION: np.array([frame.action for frame in frames], np.float32)
    }
    poses = [frame.odometry.pose for frame in frames if frame.odometry is not None]
    if len(poses) == len(frames):
        columns[STATE] = np.array(poses, np.float32)
    else:
        tally.say(
            f"{len(frames) - len(poses)} of {len(frames)} frames lack odometry; {STATE} is left out"
        )
    return columns | {
        SUCCESS: np.array([frame.success for frame in frames]),
        "timestamp": (places / FPS).astype(np.float32),
        "frame_index": places,
        "episode_index": np.repeat(np.arange(len(episodes)), lengths),
        "index": np.arange(len(frames)),
        "task_index": np.repeat([tasks.index(episode.task) for episode in episodes], lengths),
    }


def _info(
    columns: dict[str, NDArray[Any]], episodes: int, tasks: int, size: tuple[int, int]
) -> dict[str, Any]:
    width, height = size
    film = {
        "video.height": height, "video.width": width, "video.codec": _CODEC, "video.pix_fmt": _PIXELS,
        "video.is_depth_map": False, "video.fps": FPS, "video.channels": 3, "has_audio": False,
    }  # fmt: skip
    names = {ACTION: list(VELOCITIES), STATE: list(POSE)}
    rows = {
        key: {
            "dtype": str(values.dtype),
            "shape": list(values.shape[1:]) or [1],
            "names": names.get(key),
        }
        for key, values in columns.items()
    }
    shown = {
        "dtype": "video",
        "shape": [height, width, 3],
        "names": ["height", "width", "channels"],
        "info": film,
    }
    return {
        "codebase_version": "v3.0", "total_episodes": episodes, "total_frames": len(columns["index"]),
        "total_tasks": tasks, "chunks_size": _CHUNK, "data_files_size_in_mb": _DATA_MB,
        "video_files_size_in_mb": _VIDEO_MB, "fps": FPS, "splits": {"train": f"0:{episodes}"}, "data_path": DATA,
        "video_path": VIDEO, "features": {CAMERA: shown, **rows},
    }  # fmt: skip


def _statistics(
    columns: dict[str, NDArray[Any]], rows: slice, episodes: list[_Episode]
) -> dict[str, Statistics]:
    """Return the statistics of each feature, for normalization."""
    images = sum((episode.counts for episode in episodes), np.zeros((3, 256), np.int64))
    found = {CAMERA: _of_images(images, sum(len(episode.frames) for episode in episodes))}
    for key, values in columns.items():
        part = values[rows].reshape(len(values[rows]), -1)
        exact = part.astype(np.float64)
        # As in lerobot, extremes keep the type of the values.
        made = {
            "min": part.min(axis=0),
            "max": part.max(axis=0),
            "mean": exact.mean(axis=0),
            "std": exact.std(axis=0),
        }
        made |= {name: np.quantile(exact, share, axis=0) for name, share in _QUANTILES.items()}
        found[key] = {name: value.tolist() for name, value in made.items()} | {"count": [len(part)]}
    return found


def _of_images(counts: NDArray[np.int64], images: int) -> Statistics:
    """Return the statistics of images by their summed histograms; values of 0 to 1, (3, 1, 1)."""
    levels = np.arange(256) / 255.0
    below = np.cumsum(counts, axis=1) / counts.sum(axis=1, keepdims=True)
    shares = np.diff(below, axis=1, prepend=0.0)
    mean = shares @ levels
    variance = np.maximum(shares @ levels**2 - mean**2, 0.0)  # Rounding can make it negative.
    there = [levels[channel > 0] for channel in counts]
    found = {
        "min": [one[0] for one in there],
        "max": [one[-1] for one in there],
        "mean": mean,
        "std": variance**0.5,
    }
    found |= {
        name: levels[np.minimum((below < share).sum(axis=1), 255)]
        for name, share in _QUANTILES.items()
    }
    return {name: np.reshape(value, (3, 1, 1)).tolist() for name, value in found.items()} | {
        "count": [images]
    }


def _cells(values: NDArray[Any]) -> Any:  # noqa: ANN401 - of a package without types
    """Return a column; a cell is a number or a list of numbers."""
    import pyarrow as pa  # noqa: PLC0415 - as above

    flat = pa.array(values.ravel())
    return flat if values.ndim == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])


def _write_table(path: Path, table: Any, metadata: dict[str, str] | None = None) -> None:  # noqa: ANN401 - as above
    import pyarrow.parquet as pq  # noqa: PLC0415 - as above

    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table.replace_schema_metadata(metadata), path)


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=4) + "\n", encoding="utf-8")
