"""Frames of videos as JPEG, upright, by their times."""

import math
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from functools import partial
from itertools import pairwise
from typing import IO, Any, Final

import numpy as np
from numpy.typing import NDArray

from schemas.codec import printable
from services.importers.drive import (
    MOST_SAMPLES,
    Array,
    Image,
    Images,
    ImportFailure,
    NotAnImage,
    Tally,
)
from services.importers.images import Row, raw_as_jpeg
from services.importers.inside import Inside
from services.importers.ticks import HOLD_S
from services.kit.jpeg import MOST_PIXELS

#: Containers by their first bytes and where these stand. Others can name further files to open.
_CONTAINERS: Final = (
    (4, b"ftyp", "mp4"), (4, b"moov", "mp4"), (0, b"\x1aE\xdf\xa3", "matroska"), (0, b"RIFF", "avi"),
)  # fmt: skip
_ROUNDING_S: Final = 1e-3  # Tables of milliseconds.
SUFFIXES: Final = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi")


@contextmanager
def _opened(file: IO[bytes], called: str) -> Iterator[tuple[Any, Any]]:
    """Open a video and its stream of frames; ImportFailure if they are unreadable."""
    try:
        import av  # noqa: PLC0415 - of the extra `formats`
    except ImportError:
        raise ImportFailure(f"{called}: needs av: pip install -e '.[formats]'") from None
    start = file.read(12)
    file.seek(0)
    forms = [form for at, mark, form in _CONTAINERS if start.startswith(mark, at)]
    if not forms:
        raise ImportFailure(f"{called}: not a readable video: neither MP4, Matroska nor AVI")
    try:
        with closing(av.open(file, mode="r", format=forms[0])) as container:
            if not container.streams.video:
                raise ImportFailure(f"{called}: no video")
            stream = container.streams.video[0]
            if stream.codec_context.width * stream.codec_context.height > MOST_PIXELS:
                raise ImportFailure(f"{called}: too large (more than {MOST_PIXELS} pixels)")
            stream.thread_type = "NONE"
            stream.codec_context.options = {"max_pixels": str(MOST_PIXELS)}
            yield container, stream
    except (av.FFmpegError, OSError, ValueError, OverflowError, MemoryError) as error:
        reason = getattr(error, "strerror", None) or type(error).__name__
        raise ImportFailure(f"{called}: not a readable video: {reason}") from None


class Film:
    """The frames of a video on the clock of a table.

    Each row is a frame if there are as many; else the times of the table count from the first
    frame, or, if its first time is later than the end, the video begins there.
    """

    def __init__(
        self, inside: Inside, name: str, episodes: Sequence[Sequence[Row]], tally: Tally
    ) -> None:
        self._inside = inside
        self._name = name
        with inside.open(name) as file:
            self._shown_s = frame_times(file, inside.called(name))
        if self._shown_s.size < 2:
            raise ImportFailure(f"{inside.called(name)}: a video of fewer than two frames")
        self._clock_s = self._shown_s - self._shown_s[0]
        self._frame_a_row = self._shown_s.size == sum(map(len, episodes))
        if self._frame_a_row:
            return
        spans_s = [
            (min(row.time_s for row in rows), max(row.time_s for row in rows)) for rows in episodes
        ]
        if any(later[0] < before[1] for before, later in pairwise(sorted(spans_s))):
            raise ImportFailure(
                f"{inside.called(name)}: episodes overlap in time; time_s must count from the "
                "first frame of the video in all of them"
            )
        begin_s = episodes[0][0].time_s
        if begin_s > self._clock_s[-1]:
            tally.say(f"the video {printable(name)} begins at the first row")
            self._clock_s = self._clock_s + begin_s
        within = self._within(min(spans_s)[0], max(end_s for _, end_s in spans_s))
        tally.count("frames of the video have no row (left out)", self._clock_s.size - within.size)
        late = [row for rows in episodes for row in rows if row.time_s > self._clock_s[-1] + HOLD_S]
        tally.count("rows are later than the end of the video (left out)", len(late))

    def part(self, rows: Sequence[Row]) -> tuple[Array, Images]:
        """Return the times and the images of the frames of rows, or else within their times."""
        if self._frame_a_row:
            numbers = [row.number for row in rows]
            times_s = np.array([row.time_s for row in rows])
            return times_s, partial(self._images, self._shown_s[numbers])
        frames = self._within(rows[0].time_s, rows[-1].time_s)
        if not frames.size:
            raise ImportFailure(
                f"{self._inside.called(self._name)}: no frame within the times of the table; "
                "time_s counts from the first frame"
            )
        return self._clock_s[frames], partial(self._images, self._shown_s[frames])

    def _within(self, first_s: float, last_s: float) -> NDArray[np.intp]:
        """Return the frames between two rows; the last velocity holds for a while."""
        begun = self._clock_s >= first_s - _ROUNDING_S
        return np.flatnonzero(begun & (self._clock_s <= last_s + HOLD_S))

    def _images(self, times_s: Array) -> Iterator[Image]:
        tolerance_s = float(np.median(np.diff(self._shown_s))) / 2.0
        with self._inside.open(self._name) as file:
            yield from frames_at(file, self._inside.called(self._name), times_s, tolerance_s)


def frame_times(file: IO[bytes], called: str) -> Array:
    """Return the times of all frames of a video, ascending, without decoding them."""
    with _opened(file, called) as (container, stream):
        times = []
        for packet in container.demux(stream):
            if packet.size and (packet.pts is not None or packet.dts is not None):
                times.append(packet.dts if packet.pts is None else packet.pts)
            if len(times) > MOST_SAMPLES:
                raise ImportFailure(f"{called}: too large (more than {MOST_SAMPLES} frames)")
        return np.sort(np.array(times, dtype=np.float64)) * float(stream.time_base or 1.0)


def frames_at(file: IO[bytes], called: str, times_s: Array, tolerance_s: float) -> Iterator[Image]:
    """Yield the frame of a video nearest to each time, ascending; ImportFailure if unreadable."""
    with _opened(file, called) as (container, stream):
        if times_s[0] > 0.0 and stream.time_base:
            begin = math.floor(times_s[0] / float(stream.time_base))
            container.seek(begin, stream=stream, backward=True)
        yield from _nearest(container.decode(stream), times_s, tolerance_s)


def _nearest(frames: Iterator[Any], times_s: Array, tolerance_s: float) -> Iterator[Image]:
    held = None
    following = next(frames, None)
    for time_s in times_s.tolist():
        while following is not None and _off(following, time_s) <= _off(held, time_s):
            held = following
            following = next(frames, None)
        yield partial(_frame, held if _off(held, time_s) <= tolerance_s else None)


def _off(frame: Any, time_s: float) -> float:  # noqa: ANN401 - of a package without types
    return math.inf if frame is None or frame.time is None else abs(float(frame.time) - time_s)


def _frame(frame: Any) -> bytes:  # noqa: ANN401 - as above
    if frame is None:
        raise NotAnImage("frames are not in the video")
    # A phone stores a video lying; its frames carry the counter-clockwise turn.
    pixels = np.rot90(frame.to_ndarray(format="rgb24"), round(frame.rotation / 90.0))
    return raw_as_jpeg(np.asarray(pixels, dtype=np.uint8))
