"""A camera that OpenCV opens: its newest picture, and when it was taken.

A picture that waited in a buffer, of a driver or of a link that was down, must not count as new. A
device of Linux stamps its pictures. Other sources do not: pictures that come at the usual pace are
new, and pictures that come in a burst or after a gap follow the previous one at the usual pace.
"""

import logging
import os
import statistics
import time
from collections import deque
from contextlib import suppress
from pathlib import Path
from threading import Event, Thread
from typing import Final, NamedTuple, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from services.kit.jpeg import shrunk
from services.robot.clock import SILENCE_S, now_s
from services.serial.config import CameraConfig

#: Time after the opening in which the pace of a camera is learned, and its buffers are emptied.
LEARN_S: Final = 1.0
_RETRY_S: Final = 0.5
_OPEN_MS: Final = 3000
_READ_MS: Final = 2000
# Age at which the last picture counts as missing, seconds: twice that of commands.
_SILENCE_S: Final = 2 * SILENCE_S
# Pictures whose median distance is the usual pace.
_PACED: Final = 20
# Distances of pictures that count as the usual pace, as shares of it.
_USUAL: Final = (0.7, 2.5)
# Waiting pictures catch up with the present at this rate, so that an error of the pace is forgotten.
_CATCH_UP: Final = 1.1
_OLDEST_STAMP_S: Final = 10.0
_TURNS: Final = {
    90: cv2.ROTATE_90_CLOCKWISE,
    180: cv2.ROTATE_180,
    270: cv2.ROTATE_90_COUNTERCLOCKWISE,
}
_log = logging.getLogger("serial")
_OPTIONS: Final = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
#: Options of FFmpeg by which a stream arrives without buffering.
_UNBUFFERED: Final = "fflags;nobuffer|flags;low_delay|rtsp_transport;tcp"
# Errors of streams are ours to report.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)


class Picture(NamedTuple):
    """An image (height, width, 3) in RGB, and its exposure by our clock."""

    image: NDArray[np.uint8]
    captured_s: float


class Arrivals:
    """Dates the pictures of a source without stamps by their arrivals."""

    def __init__(self) -> None:
        self._distances: deque[float] = deque(maxlen=_PACED)
        self._arrived_s = 0.0
        self._made_s = 0.0

    @property
    def pace_s(self) -> float:
        """Usual time from one picture to the next; 0 before the second one."""
        return statistics.median(self._distances) if self._distances else 0.0

    def made_s(self, arrived_s: float) -> float:
        """Return when a picture was made that arrives now."""
        made_s = arrived_s
        if self._arrived_s:
            distance_s = arrived_s - self._arrived_s
            self._distances.append(distance_s)
            least_s, most_s = (share * self.pace_s for share in _USUAL)
            if not least_s <= distance_s <= most_s:
                made_s = min(arrived_s, self._made_s + _CATCH_UP * self.pace_s)
        self._arrived_s = arrived_s
        self._made_s = made_s
        return made_s


class VideoSource:
    """Reads a camera on a thread, and reopens it when it ends."""

    def __init__(self, config: CameraConfig) -> None:
        self._config = config
        self._lacks: str | None = f"camera {config.source}: not open yet"
        self.picture: Picture | None = None
        self.changed_s = 0.0  # Exposure of the last picture that differs from the previous one.
        self.repeats = 0  # Number of equal pictures since.
        self.arrivals = Arrivals()
        self._ended = Event()
        self._thread = Thread(target=self._run, name="camera", daemon=True)
        self._thread.start()

    def lacks(self) -> str | None:
        """Return why no new picture arrives, or None."""
        picture = self.picture
        if self._lacks is not None or picture is None:
            return self._lacks or f"camera {self._config.source}: no picture yet"
        age_s = now_s() - picture.captured_s
        if age_s > _SILENCE_S:
            return f"camera {self._config.source}: the last picture is {age_s:.1f} s old"
        return None

    def close(self) -> None:
        """End reading; a read that hangs ends with the process."""
        self._ended.set()
        self._thread.join(_OPEN_MS / 1000)

    def _run(self) -> None:
        complaint: str | None = None
        while not self._ended.is_set():
            capture = opened(self._config)
            if capture.isOpened():
                _log.info("camera %s is open (%s)", self._config.source, capture.getBackendName())
                complaint = None
                with suppress(cv2.error):
                    self._read(capture)
                file = _is_file(self._config.source)
                why = "the video begins again" if file else "ended; is it still plugged in?"
                self._lacks = f"camera {self._config.source}: {why}"
            else:
                self._lacks = f"camera {self._config.source}: {_why(self._config.source)}"
            capture.release()
            if self._lacks != complaint and not self._ended.is_set():
                complaint = self._lacks
                _log.warning("%s", complaint)
            self._ended.wait(_RETRY_S)

    def _read(self, capture: cv2.VideoCapture) -> None:
        """Read pictures until the source ends."""
        self.arrivals = Arrivals()
        file = _is_file(self._config.source)
        pace_s = 1.0 / max(1.0, capture.get(cv2.CAP_PROP_FPS)) if file else 0.0
        due_s = now_s()
        learned_s = due_s if file else due_s + LEARN_S
        while not self._ended.is_set() and capture.grab():
            arrived_s = now_s()
            made_s = self._made_s(capture, arrived_s)
            retrieved, image = capture.retrieve()
            if not retrieved:
                return
            if arrived_s >= learned_s:
                self._take(cast("NDArray[np.uint8]", image), made_s - self._config.latency_s)
            if file:
                due_s += pace_s
                self._ended.wait(max(0.0, due_s - now_s()))

    def _made_s(self, capture: cv2.VideoCapture, arrived_s: float) -> float:
        made_s = self.arrivals.made_s(arrived_s)
        if capture.getBackendName() == "V4L2":
            age_s = time.monotonic() - capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
            if 0.0 <= age_s <= _OLDEST_STAMP_S:
                return arrived_s - age_s
        return made_s

    def _take(self, bgr: NDArray[np.uint8], captured_s: float) -> None:
        image = cast("NDArray[np.uint8]", cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB))
        if image.shape[1] > self._config.width:
            image = shrunk(image, self._config.width)
        if self._config.rotate:
            image = cast("NDArray[np.uint8]", cv2.rotate(image, _TURNS[self._config.rotate]))
        if self.picture is not None and np.array_equal(self.picture.image, image):
            self.repeats += 1
        else:
            self.repeats = 0
            self.changed_s = captured_s
        self.picture = Picture(image, captured_s)
        self._lacks = None


def opened(config: CameraConfig) -> cv2.VideoCapture:
    """Open a camera; the result can be closed already."""
    source = config.source
    if isinstance(source, str) and not source.startswith("/dev/"):
        # One thread decodes, since every further one delays the pictures by one.
        limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, _OPEN_MS, cv2.CAP_PROP_READ_TIMEOUT_MSEC, _READ_MS,
                  cv2.CAP_PROP_N_THREADS, 1]  # fmt: skip
        # OpenCV reads the options from the environment. They cost a video file its last frame.
        ours = "://" in source and _OPTIONS not in os.environ
        if ours:
            os.environ[_OPTIONS] = _UNBUFFERED
        capture = cv2.VideoCapture(source, cv2.CAP_FFMPEG, limits)
        if ours:
            del os.environ[_OPTIONS]
        return capture
    capture = cv2.VideoCapture(source, cv2.CAP_V4L2)
    # Compressed, since raw pictures of this size exceed USB 2 at 30 pictures a second.
    capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG"))
    capture.set(cv2.CAP_PROP_FRAME_WIDTH, config.width)
    capture.set(cv2.CAP_PROP_FRAME_HEIGHT, config.width * 3 / 4)
    return capture


def _is_file(source: int | str) -> bool:
    return isinstance(source, str) and Path(source).is_file()


def _why(source: int | str) -> str:
    """Return why a source cannot be opened."""
    if isinstance(source, str) and "://" in source:
        return "no video stream; does its address open in a browser or player on this machine?"
    path = Path(f"/dev/video{source}" if isinstance(source, int) else source)
    if not path.exists():
        return "not found; is it plugged in? (`ls /dev/video*` lists cameras)"
    if not os.access(path, os.R_OK):
        return "permission denied; add your user to the group video, and log in again"
    return "no video; it is in use by another process, or has no format that OpenCV reads"
