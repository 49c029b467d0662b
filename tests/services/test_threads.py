"""How many threads of the numerical libraries a process of ours has."""

import os
import subprocess
import sys

import pytest

_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")
#: Whatever threads a library has besides the first one, it has started by now.
_PROGRAM = "import services, numpy, os; a = numpy.ones((600, 600)); a @ a; print(len(os.listdir('/proc/self/task')))"


def threads(**wanted: str) -> int:
    kept = {name: value for name, value in os.environ.items() if name not in _THREADS}
    run = subprocess.run([sys.executable, "-c", _PROGRAM], env=kept | wanted, stdout=subprocess.PIPE, check=True)
    return int(run.stdout)


def test_products_take_one_thread() -> None:
    assert threads() == 1


@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="OpenBLAS starts no more threads than there are cores")
@pytest.mark.parametrize("name", _THREADS)
def test_a_person_may_want_more(name: str) -> None:
    assert threads(**{name: "2"}) == 2
