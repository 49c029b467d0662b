"""How many threads of the numerical libraries a process of ours has."""

import os
import subprocess
import sys

#: Whatever threads a library has besides the first one, it has started by now.
_PROGRAM = "import services, numpy, os; a = numpy.ones((600, 600)); a @ a; print(len(os.listdir('/proc/self/task')))"


def test_products_take_one_thread() -> None:
    kept = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    assert int(subprocess.check_output([sys.executable, "-c", _PROGRAM], env=kept)) == 1
