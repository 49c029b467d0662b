"""Errors that end a command or a service: one line, and an exit status that scripts can rely on."""

import errno
from typing import Final

#: Logged by a process that cannot get memory: it would fail again, while a new process begins with little in use.
NO_MEMORY: Final = "out of memory; this process ends and must be started again"
#: Messages of Python, without memory for a thread's stack; of C++, as OpenCV passes it on; and of the loader.
_TOLD: Final = (
    "can't start new thread",
    "std::bad_alloc",
    "failed to map segment from shared object",
)
_OPENCV_NO_MEMORY: Final = -4  # `cv2.Error.STS_NO_MEM`.


class UsageError(Exception):
    """The command was used wrongly; exit status 2."""


class JobError(Exception):
    """What was asked for cannot be done; the text says why in one line. Exit status 1."""


def describe_os_error(error: OSError) -> str:
    """Say in one line what the system refused, and of which file."""
    reason = error.strerror or str(error) or type(error).__name__
    return reason if error.filename is None else f"{error.filename}: {reason}"


def out_of_memory(error: BaseException) -> bool:
    """Return whether an error tells that the process cannot get memory, of Python, the system or OpenCV."""
    if isinstance(error, OSError):
        return error.errno == errno.ENOMEM
    opencv = type(error).__module__ == "cv2" and getattr(error, "code", None) == _OPENCV_NO_MEMORY
    return isinstance(error, MemoryError) or opencv or str(error).endswith(_TOLD)
