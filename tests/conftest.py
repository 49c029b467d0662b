"""What holds for all tests."""

from __future__ import annotations

import signal


def pytest_configure() -> None:
    """Have the programs that tests start take signals as usual, also under nohup or in the background.

    What this process ignores its children ignore too; what it handles they take by default.
    """
    for number in (signal.SIGHUP, signal.SIGINT, signal.SIGQUIT):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, lambda *_: None)
