"""Link to a base: a serial port, TCP or UDP, on which velocities go out and lines come in.

A velocity is only worth sending while it is new. No queue may hold an old one, so a line is sent
when the earlier lines have left, and is dropped otherwise: the next one follows 0.02 s later. A
link on which no line leaves for `SILENCE_S` is closed, with all that it still holds.
"""

import errno
import fcntl
import logging
import os
import re
import select
import socket
import struct
import termios
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from threading import Event, Lock, Thread
from typing import Any, Final, TypeAlias
from urllib.parse import urlsplit

import serial

from schemas.base import STANDING
from schemas.codec import printable
from services.robot.clock import SILENCE_S, now_s
from services.serial.config import SerialConfig

_RETRY_S: Final = 0.5
_CONNECT_S: Final = 2.0
# Period in which the last stop is sent again while earlier lines wait.
_RESEND_S: Final = 0.005
# Period of the check for lines and for silence.
_POLL_S: Final = 0.05
#: Silence of the actuator, between episodes or by a fault, after which the link sends the stop line.
IDLE_S: Final = 0.2
#: Lines on their way over a network. Small controllers confirm only every second packet at once.
_ON_THEIR_WAY: Final = 4
_LONGEST: Final = 512  # Maximum size of a received line, bytes.
_REASONS: Final = {
    errno.ENOENT: "not found; is it plugged in?",
    errno.EACCES: "permission denied; add your user to the group dialout, and log in again",
    errno.EAGAIN: "in use by another process",
    errno.ECONNREFUSED: "connection refused; no process listens there",
}
_log = logging.getLogger("serial")
# A `serial.Serial` or a socket, which never waits.
Port: TypeAlias = Any


def opened(address: str, baud: int) -> Port:
    """Open a serial port (a path), tcp://HOST:PORT or udp://HOST:PORT; OSError if it fails."""
    where = urlsplit(address)
    if not where.scheme:
        if Path(address).exists() and not Path(address).is_char_device():
            raise OSError(errno.ENOTTY, "not a serial port")
        try:
            return serial.Serial(address, baud, timeout=0, write_timeout=0, exclusive=True)
        except termios.error as error:
            raise OSError(*error.args) from error
    kind = socket.SOCK_DGRAM if where.scheme == "udp" else socket.SOCK_STREAM
    network = socket.socket(socket.AF_INET, kind)
    network.settimeout(_CONNECT_S)
    network.connect((where.hostname, where.port))
    if kind is socket.SOCK_STREAM:
        network.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    network.setblocking(False)
    return network


def _discard(port: Port) -> None:
    """Discard what a port has not yet sent, so that it is neither delivered late nor waited for."""
    with suppress(OSError, termios.error):
        if isinstance(port, socket.socket):
            port.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        else:
            termios.tcflush(port.fileno(), termios.TCOFLUSH)


class LineLink:
    """Sends text and receives lines; reconnects by itself.

    Any thread can call ``send``, which never waits. The link's own thread calls ``take`` with each
    line and its arrival time.
    """

    def __init__(self, config: SerialConfig, take: Callable[[str, float], None]) -> None:
        self._config = config
        self._address = config.base.address
        self._stop = config.command(STANDING)
        self._take = take
        self._lock = Lock()
        self._port: Port = None
        self._lacks: str | None = f"{self._address}: not open yet"
        self._asked_s = now_s()
        self._sent_s = now_s()
        self._ended = Event()
        self.last = ""  # The last received line.
        self._thread = Thread(target=self._run, name="link", daemon=True)
        self._thread.start()

    def lacks(self) -> str | None:
        """Return why the base cannot be reached, or None."""
        return self._lacks

    def send(self, text: str) -> bool:
        """Send a text if the earlier ones have left; drop it otherwise, and return False."""
        with self._lock:
            self._asked_s = now_s()
            if self._port is not None:
                try:
                    return self._write(self._port, text.encode())
                except OSError as error:
                    self._break(error)
        return False

    def close(self) -> None:
        """Stop the base, and close the link; a thread that hangs ends with the process."""
        while not self.send(self._stop) and self._lacks is None:
            time.sleep(_RESEND_S)
        self._ended.set()
        self._thread.join(_CONNECT_S)

    def _write(self, port: Port, data: bytes) -> bool:
        most = _ON_THEIR_WAY * len(data) if isinstance(port, socket.socket) else 0
        waiting = struct.unpack("i", fcntl.ioctl(port.fileno(), termios.TIOCOUTQ, bytes(4)))[0]
        if waiting > most:
            if self._asked_s - self._sent_s > SILENCE_S:
                raise TimeoutError(f"takes no data for {SILENCE_S:g} s")
            return False
        if os.write(port.fileno(), data) < len(data):
            raise TimeoutError("takes only a part of a line")
        self._sent_s = self._asked_s
        return True

    def _break(self, error: Exception) -> None:
        self._port = None
        text = getattr(error, "strerror", None) or str(error)
        reason = _REASONS.get(getattr(error, "errno", None) or 0, text)
        self._lacks = f"{self._address}: {printable(reason)}"

    def _run(self) -> None:
        complaint: str | None = None
        while not self._ended.is_set():
            try:
                port = opened(self._address, self._config.base.baud)
            except (OSError, ValueError) as error:
                self._break(error)
            else:
                complaint = None
                self._use(port)
            if self._lacks != complaint:
                complaint = self._lacks
                _log.warning("%s; the robot stands", complaint)
            self._ended.wait(_RETRY_S)

    def _use(self, port: Port) -> None:
        """Use a port until it breaks or the link is closed."""
        try:
            self._connect(port)
            self._listen(port)
        except OSError as error:
            with self._lock:
                self._break(error)
        with self._lock:
            self._port = None
        if self._lacks is not None:
            _discard(port)
        port.close()

    def _connect(self, port: Port) -> None:
        self._ended.wait(self._config.base.settle_s)
        opening = self._config.opening().encode()
        if opening:
            os.write(port.fileno(), opening)
        _log.info("%s is open", self._address)
        with self._lock:
            self._sent_s = now_s()
            self._port = port
            self._lacks = None

    def _listen(self, port: Port) -> None:
        """Take lines until the link breaks or is closed."""
        ends = re.compile(rb"[\r\n]+|" + re.escape(self._config.base.end.encode()))
        rest = b""
        while self._port is port and not self._ended.is_set():
            if now_s() - self._asked_s > IDLE_S:
                self.send(self._stop)
            if not select.select([port], [], [], _POLL_S)[0]:
                continue
            data = os.read(port.fileno(), 4096)
            if not data:
                raise ConnectionError("closed by the base")
            *lines, rest = ends.split(rest + data)
            rest = rest[: _LONGEST + 1]  # Enough to recognise a line that is too long.
            arrived_s = now_s()
            for line in filter(None, lines):
                if len(line) <= _LONGEST:
                    self.last = printable(line.decode(errors="replace"))
                    self._take(line.decode(errors="replace"), arrived_s)
