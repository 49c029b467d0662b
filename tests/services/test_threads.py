"""How many threads of the numerical libraries a process of ours has, and heaps of all threads."""

import os
import subprocess
import sys

import pytest

from services.cli.stack import free_endpoint

#: Whatever threads a library has besides the first one, it has started by now.
_PROGRAM = "import services, numpy, os; a = numpy.ones((600, 600)); a @ a; print(len(os.listdir('/proc/self/task')))"


def test_products_take_one_thread() -> None:
    kept = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    assert int(subprocess.check_output([sys.executable, "-c", _PROGRAM], env=kept)) == 1


#: A router, and a thread for each of many sessions; Python leaves what is large to malloc.
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
ctypes.CDLL(None).malloc_stats()
router.close()
"""


@pytest.mark.zenoh
def test_threads_share_one_heap_a_core() -> None:
    said = subprocess.run(
        [sys.executable, "-c", _HEAPS, free_endpoint()], check=True, capture_output=True, text=True
    )
    assert 1 <= said.stderr.count("Arena") <= (os.cpu_count() or 1) + 1
