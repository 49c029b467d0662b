"""Become a program that is told to stop when the process that started it dies, however that one dies.

A script of the standard library alone, ``python child.py PARENT COMMAND...``: it starts in a moment, and asking the
kernel here, rather than between fork and exec of the parent, cannot deadlock on a lock of the parent's threads.
"""

import ctypes
import os
import signal
import sys

PR_SET_PDEATHSIG = (
    1  # From <linux/prctl.h>; it outlives exec, and is about the thread that started the process.
)


def tied(*command: str) -> list[str]:
    """Return the command that runs another one for as long as this process lives."""
    return [sys.executable, "-I", "-S", __file__, str(os.getpid()), *command]


def main() -> None:
    """Tie this process to its parent, then become the command."""
    parent, *command = sys.argv[1:]
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, ctypes.c_ulong(signal.SIGTERM))
        if os.getppid() != int(parent):
            sys.exit("the process that wanted this service has died")
    os.execv(command[0], command)  # noqa: S606 - the command is Stack's own


if __name__ == "__main__":
    main()
