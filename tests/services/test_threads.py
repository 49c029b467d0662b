"""Threads and memory of a process: few threads, few heaps, freed memory is given back."""

import os
import subprocess
import sys
from typing import Final
from xml.etree import ElementTree

import psutil
import pytest

from services.cli.stack import free_endpoint
from services.kit.memory import give_back

_PROGRAM = "import services, numpy, os; a = numpy.ones((600, 600)); a @ a; print(len(os.listdir('/proc/self/task')))"


def test_products_take_one_thread() -> None:
    kept = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    assert int(subprocess.check_output([sys.executable, "-c", _PROGRAM], env=kept)) == 1


#: A router and 64 threads; Python leaves large blocks to malloc.
_HEAPS = """
import ctypes, sys, threading
from services.kit.bus import Router
router, all_there, held = Router(sys.argv[1]), threading.Barrier(65), []
def allocate():
    held.append(bytearray(10_000))
    all_there.wait()
for _ in range(64):
    threading.Thread(target=allocate, daemon=True).start()
all_there.wait()
libc = ctypes.CDLL(None)
libc.fdopen.restype = ctypes.c_void_p
libc.malloc_info(0, ctypes.c_void_p(libc.fdopen(1, b"w")))
libc.fflush(None)
router.close()
"""


@pytest.mark.zenoh
def test_threads_share_one_heap_per_core() -> None:
    told = subprocess.check_output([sys.executable, "-c", _HEAPS, free_endpoint()])
    heaps = ElementTree.fromstring(told).findall("heap")  # noqa: S314 - our own process's
    assert 1 <= len(heaps) <= (os.cpu_count() or 1) + 1


_BLOCK: Final = 100_000  # Bytes; smaller than what the system gives singly, and takes back at once.
_BLOCKS: Final = 500


def _held() -> int:
    return int(psutil.Process().memory_info().rss)


def test_freed_memory_is_given_back() -> None:
    blocks = [bytes([1]) * _BLOCK for _ in range(_BLOCKS)]
    pins = blocks[::50]
    before = _held()
    blocks.clear()
    give_back()
    assert before - _held() > 0.8 * _BLOCK * (_BLOCKS - len(pins))
