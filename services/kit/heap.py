"""Memory of processes that pass images on."""

from __future__ import annotations

import ctypes
from contextlib import suppress
from typing import Final

#: From <malloc.h>: how much free memory at the top of the heap is kept, and from what size on a piece is asked of the
#: system for itself and given back at once; 32 MiB is the most that glibc takes.
_M_TRIM_THRESHOLD: Final = -1
_M_MMAP_THRESHOLD: Final = -3
_KEPT_BYTES: Final = 128 << 20
_OWN_BYTES: Final = 32 << 20


def keep_freed_memory() -> None:
    """Have the C library keep the memory that a frame took, for the next one.

    By default glibc gives it back to the system after every frame, and to fault it in again takes as long as to send
    the frame. Other C libraries are left as they are.
    """
    with suppress(AttributeError, OSError):
        library = ctypes.CDLL(None)
        library.mallopt(_M_TRIM_THRESHOLD, _KEPT_BYTES)
        library.mallopt(_M_MMAP_THRESHOLD, _OWN_BYTES)
