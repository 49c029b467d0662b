"""MP4 files of a LeRobotDataset: the images of many episodes, one after the other."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from services.exporters.drives import ExportFailure

#: As lerobot has it for random access: every other image stands for itself, and none is told by a later one. With this
#: quality nobody sees a difference.
_OPTIONS: Final = {"crf": "18", "g": "2", "bf": "0"}
CODEC, PIXELS = "h264", "yuv420p"


class Videos:
    """Writes images into files that are not much larger than they should be.

    Parameters
    ----------
    folder, name, key
        Of the data set, of a file in it, and of the camera in that name.
    fps
        Images a second.
    chunk
        How many files a folder has.
    most_mb
        From how many megabytes on the next episode begins another file.
    """

    def __init__(self, folder: Path, name: str, key: str, fps: int, chunk: int, most_mb: int) -> None:
        #: Columns and rows, once they are known.
        self.size: tuple[int, int] | None = None
        self._folder, self._name, self._key, self._chunk = folder, name, key, chunk
        self._period, self._most = Fraction(1, fps), most_mb * 2**20
        self._files = -1
        self._images = 0
        self._written = 0
        self._container: Any = None
        self._stream: Any = None

    def begin_episode(self, pixels: NDArray[np.uint8]) -> tuple[dict[str, int], int]:
        """Make room for images like this one; return in which file they will be, and how many are there already."""
        if self.size is None:
            height, width = pixels.shape[:2]
            if width % 2 or height % 2:
                raise ExportFailure(
                    f"images of {width}x{height} pixels: a video has an even number of columns and rows"
                )
            self.size = width, height
        if self._container is None or self._written >= self._most:
            self.close()
            self._open(self.size)
        return self._at, self._images

    @property
    def _at(self) -> dict[str, int]:
        chunk, file = divmod(self._files, self._chunk)
        return {"chunk_index": chunk, "file_index": file}

    def _open(self, size: tuple[int, int]) -> None:
        import av  # noqa: PLC0415 - of the extra `formats`

        self._files += 1
        self._images = self._written = 0
        path = self._folder / self._name.format(video_key=self._key, **self._at)
        path.parent.mkdir(parents=True, exist_ok=True)
        self._container = av.open(str(path), "w", format="mp4")
        self._stream = self._container.add_stream("libx264", rate=1 / self._period, options=_OPTIONS)
        self._stream.width, self._stream.height = size
        self._stream.pix_fmt = PIXELS

    def add(self, pixels: NDArray[np.uint8]) -> None:
        """Write an image (rows, columns, 3)."""
        import av  # noqa: PLC0415 - as above

        frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
        frame.time_base, frame.pts = self._period, self._images
        self._images += 1
        packets = self._stream.encode(frame)
        self._written += sum(packet.size for packet in packets)
        self._container.mux(packets)

    def close(self) -> None:
        """Finish the last file."""
        if self._container is None:
            return
        container, self._container = self._container, None
        try:
            container.mux(self._stream.encode())
        finally:
            container.close()
