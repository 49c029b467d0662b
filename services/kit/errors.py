"""Errors that end a command or a service with one line and a documented exit status."""

import errno
import traceback
from pathlib import Path
from typing import Final

#: Logged without memory: a retry fails too, while a new process starts with little memory in use.
NO_MEMORY: Final = "out of memory; this process ends and must be started again"
#: Messages of Python without memory for a thread's stack, of C++ through OpenCV, and of the loader.
_NO_MEMORY_ENDINGS: Final = (
    "can't start new thread",
    "std::bad_alloc",
    "failed to map segment from shared object",
)
_OPENCV_NO_MEMORY: Final = -4  # `cv2.Error.STS_NO_MEM`.


#: Folder of our packages: a checkout or the installation.
_PACKAGES: Final = Path(__file__).parents[2]
_OURS: Final = tuple(str(_PACKAGES / name) for name in ("services", "smal", "schemas"))


class UsageError(Exception):
    """Incorrect use of a command; exit status 2."""


class JobError(Exception):
    """A request that cannot be fulfilled, with the reason in one line; exit status 1."""


def describe_os_error(error: OSError) -> str:
    """Describe the system's error and its file in one line."""
    reason = error.strerror or str(error) or type(error).__name__
    return reason if error.filename is None else f"{error.filename}: {reason}"


def foreign_error(error: BaseException) -> str:
    """Describe an error of a user's code in one line, with the last line of that code."""
    text = f"{type(error).__name__}: {' '.join(str(error).split())}"
    frames = [
        frame
        for frame in traceback.extract_tb(error.__traceback__)
        if not frame.filename.startswith((*_OURS, "<"))
    ]
    return (
        f"{text} ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else text
    )


def out_of_memory(error: BaseException) -> bool:
    """Return whether an error of Python, the system or OpenCV means that memory is exhausted."""
    if isinstance(error, OSError):
        return error.errno == errno.ENOMEM
    opencv = type(error).__module__ == "cv2" and getattr(error, "code", None) == _OPENCV_NO_MEMORY
    return isinstance(error, MemoryError) or opencv or str(error).endswith(_NO_MEMORY_ENDINGS)
