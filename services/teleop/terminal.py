"""The operator's terminal: keys as they are pressed, and a status line below what has happened."""

from __future__ import annotations

import logging
import os
import select
import shutil
import sys
import termios
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from services.teleop.keys import TELL_NO_RELEASES, TELL_RELEASES

_ERASE_LINE: Final = "\r\x1b[K"
_DISABLED: Final = b"\0"
_CONTROL_CHARACTERS: Final = 6


class NoTerminalError(Exception):
    """Standard input is no terminal, so no key press can be read; the text says so in one line."""


class Terminal:
    """Standard input and output of this process, which must be a terminal; see ``open_terminal``."""

    def __init__(self) -> None:
        self._input = sys.stdin.fileno()
        self._status = ""

    def read(self) -> bytes | None:
        """Return what was typed since the last call, perhaps nothing; None when the terminal is gone."""
        if not select.select([self._input], [], [], 0.0)[0]:
            return b""
        try:
            return os.read(self._input, 1024) or None
        except OSError:
            return None

    def say(self, text: str) -> None:
        """Print a line above the status line."""
        self.write(f"{_ERASE_LINE}{text}\n{self._status}")

    def show(self, status: str) -> None:
        """Set the status line."""
        status = status[: shutil.get_terminal_size().columns - 1]
        if status != self._status:
            self._status = status
            self.write(f"{_ERASE_LINE}{status}")

    def leave(self) -> None:
        """Leave the cursor below the status line."""
        self.write("\n")

    @staticmethod
    def write(text: str) -> None:
        """Write as it is."""
        try:
            sys.stdout.write(text)
            sys.stdout.flush()
        except OSError:
            # The window was closed: ``read`` says so, and the robot is stopped in good order.
            return


class TerminalLog(logging.Handler):
    """Puts warnings above the status line rather than into it."""

    def __init__(self, terminal: Terminal) -> None:
        super().__init__(logging.WARNING)
        self._terminal = terminal

    def emit(self, record: logging.LogRecord) -> None:
        """Print one record."""
        self._terminal.say(f"{record.levelname.lower()}: {record.getMessage()}")


def require_terminal() -> None:
    """Raise NoTerminalError unless a person can type into this process."""
    if not sys.stdin.isatty():
        raise NoTerminalError("standard input is not a terminal; run this from one, not through a pipe or a script")


@contextmanager
def open_terminal() -> Iterator[Terminal]:
    """Read keys without waiting for Enter and without showing them; restored however the context is left.

    Raises
    ------
    NoTerminalError
        When standard input is not a terminal.
    """
    require_terminal()
    before = termios.tcgetattr(sys.stdin)
    terminal = Terminal()
    log = TerminalLog(terminal)
    try:
        tty.setcbreak(sys.stdin, termios.TCSANOW)
        mode = termios.tcgetattr(sys.stdin)
        # A driver that Ctrl-Z puts to sleep could not stop the robot.
        mode[_CONTROL_CHARACTERS][termios.VSUSP] = _DISABLED
        termios.tcsetattr(sys.stdin, termios.TCSANOW, mode)
        logging.getLogger().addHandler(log)
        terminal.write(TELL_RELEASES)
        yield terminal
    finally:
        logging.getLogger().removeHandler(log)
        terminal.write(TELL_NO_RELEASES)
        terminal.leave()
        # Keys that nobody read must not become the shell's next command.
        _restore(before)


def _restore(mode: list[object]) -> None:
    try:
        termios.tcsetattr(sys.stdin, termios.TCSAFLUSH, mode)  # type: ignore[arg-type]
    except termios.error:
        return  # The terminal is gone, and its mode with it.
