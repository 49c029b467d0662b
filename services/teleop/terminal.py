"""The operator's terminal: keys as they are pressed, and a status line below what has happened."""

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
_LINES_KEPT: Final = 200  # Lines kept for a screen that takes none for a while.
#: How long the last lines may take to be drawn; a screen that stands still must not keep the process.
_LAST_LINES_S: Final = 1.0
_ANSWER_S: Final = (
    1.0  # How long it may take to say that it has understood; a second is a slow link.
)


class Terminal:
    """Standard input and output of this process, which must be a terminal; see ``open_terminal``.

    A thread of its own draws: a screen that takes nothing (a slow link) holds up neither keys nor heartbeats.
    """

    def __init__(self) -> None:
        self._input = sys.stdin.fileno()
        self._output = sys.stdout.fileno()
        self._changed = threading.Condition()
        self._lines: deque[str] = deque(maxlen=_LINES_KEPT)
        self._status = self._drawn = ""
        self._closed = False
        self.tells_releases = False  # Whether the terminal has said that it tells releases.
        self._drawer = threading.Thread(target=self._draw, name="screen", daemon=True)
        self._drawer.start()

    def read(self, wait_s: float = 0.0) -> bytes | None:
        """Return what was typed since the last call, perhaps nothing; None when the terminal is gone."""
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
        """Write as it is, and wait until the terminal has taken it."""
        data = text.encode(errors="replace")
        # Where the window was closed, ``read`` says so, and the robot is stopped in good order.
        with suppress(OSError):
            while data:
                data = data[os.write(self._output, data) :]

    def close(self) -> None:
        """Draw what was said, and have the terminal send keys as it does for other programs."""
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
        """Read what the terminal sends before it has understood: the shell would take a release for a text."""
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
    """Puts warnings above the status line rather than into it."""

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
    """Read keys as they are pressed, until the context is left; UsageError when the input is no terminal."""
    require_terminal()
    before = termios.tcgetattr(sys.stdin)
    terminal = Terminal()
    log = TerminalLog(terminal)
    try:
        tty.setcbreak(sys.stdin, termios.TCSANOW)
        mode = termios.tcgetattr(sys.stdin)
        # Every key is a key. A driver that Ctrl-Z puts to sleep could not stop the robot, one that Ctrl-\ kills would
        # not restore the terminal, and Ctrl-S would freeze the screen.
        mode[_LOCAL_FLAGS] &= ~termios.ISIG
        mode[_INPUT_FLAGS] &= ~termios.IXON
        termios.tcsetattr(sys.stdin, termios.TCSANOW, mode)
        logging.getLogger().addHandler(log)
        terminal.write(TELL_RELEASES + ASK_RELEASES)
        yield terminal
    finally:
        logging.getLogger().removeHandler(log)
        terminal.close()
        # A terminal that is gone has no mode.
        with suppress(termios.error):
            # Not TCSAFLUSH, which waits for a screen that may take nothing.
            termios.tcsetattr(sys.stdin, termios.TCSANOW, before)
            # Keys that nobody read must not become the shell's next command.
            termios.tcflush(sys.stdin, termios.TCIFLUSH)
