"""Ctrl-C in the middle of a match is an interrupt, not a crash: compiled code must give way to it cleanly."""

import subprocess
import sys

_SCRIPT = """
import signal
from smal import solve
from tests.smal.worlds import matching_problem
X, Y = matching_problem(1, blocks=40, length=5)
solve(X, Y, 5, 0.2, 0.2)
signal.signal(signal.SIGALRM, signal.default_int_handler)
interrupted = 0
for turn in range(20):
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.01 + 0.007 * turn)
        while True:
            solve(X, Y, 5, 1e-3, 1e-3)
    except KeyboardInterrupt:
        interrupted += 1
print(interrupted)
"""


def test_an_interrupt_is_raised_as_one() -> None:
    done = subprocess.run([sys.executable, "-c", _SCRIPT], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "20"
