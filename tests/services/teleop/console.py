"""The real process in a terminal of its own."""

import os
import re
import subprocess
import sys
import termios
import threading
from pathlib import Path

from tests.services.waiting import DEADLINE_S, eventually

ROOT = Path(__file__).parents[3]


class Console:
    """``python -m services.teleop`` in a pseudo terminal, whose screen the test reads."""

    def __init__(self, endpoint: str, *flags: str) -> None:
        self._master, self.slave = os.openpty()
        self.mode_before = termios.tcgetattr(self.slave)
        self.output = ""
        self.draws = threading.Event()  # Cleared, the screen takes nothing more.
        self.draws.set()
        self.process = subprocess.Popen(
            [sys.executable, "-m", "services.teleop", "--router", endpoint, "--seed", "5", *flags],
            cwd=ROOT,
            stdin=self.slave,
            stdout=self.slave,
            stderr=self.slave,
            start_new_session=True,
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def type(self, keys: bytes) -> None:
        os.write(self._master, keys)

    def wait_for(self, pattern: str) -> None:
        eventually(lambda: re.search(pattern, self.output))

    def exit_status(self) -> int:
        """Wait for the end of the process, and return its status."""
        return self.process.wait(DEADLINE_S)

    def press_until(self, keys: bytes, pattern: str, unless: str) -> None:
        """Press again as often as the program refuses, as a person does on a machine that is too slow to answer."""
        presses = 0

        def done() -> bool:
            nonlocal presses
            if len(re.findall(unless, self.output)) >= presses:
                presses += 1
                self.type(keys)
            return re.search(pattern, self.output) is not None

        eventually(done)

    def tell_releases(self) -> None:
        """Answer, as a terminal does that knows the kitty keyboard protocol."""
        self.wait_for(r"\x1b\[>11u\x1b\[\?1004h\x1b\[\?u")
        self.type(b"\x1b[?11u")

    def hang_up(self) -> None:
        """Close the window."""
        os.close(self.slave)
        os.close(self._master)

    def close(self) -> None:
        self.draws.set()
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        for end in (self.slave, self._master):
            try:
                os.close(end)
            except OSError:
                continue  # hung up already

    def _read(self) -> None:
        try:
            while data := os.read(self._master, 4096):
                self.output += data.decode(errors="replace")
                self.draws.wait()
        except OSError:
            return
