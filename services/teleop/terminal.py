"""The operator's terminal: immediate keys, and a status line below the log."""

import logging
import os
import select
import shutil
import sys
import termios
import threading
import time
import tty
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Final

from services.kit.errors import UsageError
from services.teleop.keys import ASK_RELEASES, RELEASES_ANSWER, TELL_NO_RELEASES, TELL_RELEASES

_ERASE_LINE: Final = "\r\x1b[K"
_INPUT_FLAGS: Final = 0
_LOCAL_FLAGS: Final = 3
_LINES_KEPT: Final = 200  # Lines kept while a screen does not accept output.
#: Time limit to draw the last lines; a frozen screen must not keep the process.
_LAST_LINES_S: Final = 1.0
# Timeout of its last answer; a second is a slow link.
_ANSWER_S: Final = 1.0


class Terminal:
    """Standard input and output of this process, which must be a terminal; see ``open_terminal``.

    A separate thread draws, so that a screen that blocks (a slow link) delays neither keys nor
    heartbeats.
    """

    def __init__(self) -> None:
        self._input = sys.stdin.fileno()
        self._output = sys.stdout.fileno()
        self._changed = threading.Condition()
        self._lines: deque[str] = deque(maxlen=_LINES_KEPT)
        self._status = self._drawn = ""
        self._closed = False
        self.tells_releases = False  # Whether the terminal reports releases.
        self._drawer = threading.Thread(target=self._draw, name="screen", daemon=True)
        self._drawer.start()

    def read(self, wait_s: float = 0.0) -> bytes | None:
        """Return the input since the last call, possibly empty; None when the terminal is gone."""
        try:
            if not select.select([self._input], [], [], wait_s)[0]:
                return b""
            return os.read(self._input, 4096) or None
        except OSError:
            return None

    def say(self, text: str) -> None:
        """Print a line above the status line."""
        with self._changed:
            self._lines.append(text)
            self._changed.notify()

    def show(self, status: str) -> None:
        """Set the status line."""
        status = status[: shutil.get_terminal_size().columns - 1]
        with self._changed:
            if status != self._status:
                self._status = status
                self._changed.notify()

    def write(self, text: str) -> None:
        """Write text unchanged, and wait until the terminal has accepted it."""
        data = text.encode(errors="replace")
        # If the window was closed, ``read`` reports it, and the robot is stopped in an orderly way.
        with suppress(OSError):
            while data:
                data = data[os.write(self._output, data) :]

    def close(self) -> None:
        """Draw the remaining lines, and restore the terminal's key mode."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._drawer.join(_LAST_LINES_S)
        if self._drawer.is_alive():
            return
        self.write(f"{TELL_NO_RELEASES}\n")
        if self.tells_releases:
            self._read_the_rest()

    def _read_the_rest(self) -> None:
        """Read input until the key mode is restored: the shell would take a release for text."""
        self.write(ASK_RELEASES)
        rest = b""
        until_s = time.monotonic() + _ANSWER_S
        while not RELEASES_ANSWER.search(rest) and (wait_s := until_s - time.monotonic()) > 0.0:
            typed = self.read(wait_s)
            if typed is None:
                return
            rest += typed

    def _draw(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(
                    lambda: self._closed or self._lines or self._status != self._drawn
                )
                if not self._lines and self._status == self._drawn:
                    return
                lines = "".join(f"{line}\n" for line in self._lines)
                self._drawn = self._status
                self._lines.clear()
            self.write(f"{_ERASE_LINE}{lines}{self._drawn}")


class TerminalLog(logging.Handler):
    """Log handler that prints warnings above the status line."""

    def __init__(self, terminal: Terminal) -> None:
        super().__init__(logging.WARNING)
        self._terminal = terminal

    def emit(self, record: logging.LogRecord) -> None:
        """Print one record."""
        self._terminal.say(f"{record.levelname.lower()}: {record.getMessage()}")


def require_terminal() -> None:
    """Raise UsageError unless a person can type into this process."""
    if not sys.stdin.isatty():
        raise UsageError(
            "standard input is not a terminal; run this from one, not through a pipe or a script"
        )


@contextmanager
def open_terminal() -> Iterator[Terminal]:
    """Open the terminal for immediate keys; UsageError if the input is not a terminal."""
    require_terminal()
    before = termios.tcgetattr(sys.stdin)
    terminal = Terminal()
    log = TerminalLog(terminal)
    try:
        tty.setcbreak(sys.stdin, termios.TCSANOW)
        mode = termios.tcgetattr(sys.stdin)
        # Signals by keys are disabled: with Ctrl-Z a sleeping driver cannot stop the robot, Ctrl-\
        # leaves the terminal unrestored, and Ctrl-S freezes the screen.
        mode[_LOCAL_FLAGS] &= ~termios.ISIG
        mode[_INPUT_FLAGS] &= ~termios.IXON
        termios.tcsetattr(sys.stdin, termios.TCSANOW, mode)
        logging.getLogger().addHandler(log)
        terminal.write(TELL_RELEASES + ASK_RELEASES)
        yield terminal
    finally:
        logging.getLogger().removeHandler(log)
        terminal.close()
        # A closed terminal has no mode.
        with suppress(termios.error):
            # Not TCSAFLUSH, which waits for a screen that might not accept output.
            termios.tcsetattr(sys.stdin, termios.TCSANOW, before)
            # Unread keys must not become the shell's next command.
            termios.tcflush(sys.stdin, termios.TCIFLUSH)
