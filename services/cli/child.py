"""Run a program that is terminated when the process that started it dies.

The script uses the standard library alone: ``python child.py PARENT COMMAND...``. It starts fast.
The kernel call
happens after exec, because between fork and exec it can deadlock on a lock of the parent's threads.
"""

import ctypes
import os
import signal
import sys

# From <linux/prctl.h>; it survives exec and applies to the thread that started the process.
PR_SET_PDEATHSIG = 1


def tied(*command: str) -> list[str]:
    """Return a command that is terminated together with this process."""
    return [sys.executable, "-I", "-S", __file__, str(os.getpid()), *command]


def main() -> None:
    """Tie this process to its parent, then execute the command."""
    parent, *command = sys.argv[1:]
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, ctypes.c_ulong(signal.SIGTERM))
        if os.getppid() != int(parent):
            sys.exit("the parent process has ended")
    os.execv(command[0], command)  # noqa: S606 - the command is Stack's own


if __name__ == "__main__":
    main()
