"""Frames of a video at given times, decoded one after the other."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import closing
from typing import IO, Any

import numpy as np

from services.importers.drive import Array, ImportFailure, NotAnImage
from services.importers.images import raw_as_jpeg
from services.kit.jpeg import MOST_PIXELS


def frames_at(file: IO[bytes], called: str, times_s: Array, tolerance_s: float) -> Iterator[Any]:
    """Yield for each time, ascending, the decoded frame that is nearest; None where there is none within a tolerance.

    Only MP4 is read, and only from this file: a playlist that calls itself MP4 could name others.

    Raises
    ------
    ImportFailure
        When it is none.
    """
    import av  # noqa: PLC0415 - of the extra `formats`

    try:
        with closing(av.open(file, mode="r", format="mp4")) as container:
            if not container.streams.video:
                raise ImportFailure(f"{called}: has no video")
            yield from _nearest(
                _decoded(container, container.streams.video[0], float(times_s[0])), times_s, tolerance_s
            )
    except (av.FFmpegError, OSError, ValueError, OverflowError, MemoryError) as error:
        raise ImportFailure(f"{called}: not a video that can be read: {_said(error)}") from None


def _decoded(container: Any, stream: Any, begin_s: float) -> Iterator[Any]:  # noqa: ANN401 - of a package without types
    if stream.codec_context.width * stream.codec_context.height > MOST_PIXELS:
        raise ImportFailure(f"{container.name}: larger than {MOST_PIXELS} pixels")
    stream.thread_type = "NONE"
    stream.codec_context.options = {"max_pixels": str(MOST_PIXELS)}
    if begin_s > 0.0 and stream.time_base:
        container.seek(math.floor(begin_s / float(stream.time_base)), stream=stream, backward=True)
    yield from container.decode(stream)


def _nearest(frames: Iterator[Any], times_s: Array, tolerance_s: float) -> Iterator[Any]:
    held, following = None, next(frames, None)
    for time_s in times_s.tolist():
        while following is not None and (held is None or _off(following, time_s) <= _off(held, time_s)):
            held, following = following, next(frames, None)
        yield held if held is not None and _off(held, time_s) <= tolerance_s else None


def _off(frame: Any, time_s: float) -> float:  # noqa: ANN401 - as above
    return math.inf if frame.time is None else abs(float(frame.time) - time_s)


def jpeg_of(frame: Any) -> bytes:  # noqa: ANN401 - as above
    """Return a decoded frame as JPEG, or raise `NotAnImage`."""
    if frame is None:
        raise NotAnImage("frames are not in the video")
    return raw_as_jpeg(np.asarray(frame.to_ndarray(format="rgb24"), dtype=np.uint8))


def _said(error: Exception) -> str:
    return getattr(error, "strerror", None) or type(error).__name__
