"""A base that understands lines, and a camera on it; shares no code with the project.

``python -m tests.serial.fake_base FOLDER tcp|pty WATCHDOG_S`` prints the address of the base and of the camera (MJPEG),
and logs each step of the wheels to FOLDER/steps.jsonl. It drives in a room with painted walls. Its wheels have a
watchdog, and their odometry drifts. A line in FOLDER/harm changes it: ``freeze`` (the camera repeats its picture),
``stall`` (the camera sends nothing), ``deaf`` (it reads no line), ``lossy`` (it loses lines, and garbles its own),
``put X Y HEADING``.
"""

# ruff: noqa: S311, T201 - chance is no secret, and its first line tells its addresses

import http.server
import json
import math
import os
import pty
import random
import select
import socket
import sys
import threading
import time
import tty
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np

STEP_S = 0.02
TRACK_M = 0.2
TICKS_PER_M = 5000
WIDTH = 160
HEIGHT = 120
RATE_HZ = 15
WALL_M = 2.0  # Distance of the side walls.
LENGTH_M = 6.0


def now_s() -> float:
    """Return the seconds of the log, which the tests compare with their own."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class Base:
    """Two wheels: ``v LEFT RIGHT`` are their speeds in m/s; answers ``o LEFT RIGHT`` in ticks."""

    def __init__(self, folder: Path, watchdog_s: float) -> None:
        self.watchdog_s = watchdog_s
        self.x = self.y = self.heading = 0.0
        self.ticks = [0.0, 0.0]
        self.ordered = (0.0, 0.0)
        self.ordered_s = -math.inf
        self.log = (folder / "steps.jsonl").open("a", buffering=1)
        self.harm = folder / "harm"
        self.harmed = ""
        self.due_s = now_s()
        self.fd = -1  # File descriptor of the link; without it the odometry is lost.
        threading.Thread(target=self.live, daemon=True).start()

    def take(self, line: str) -> None:
        """Take a line; whatever it does not understand it ignores, as firmware does."""
        words = line.split()
        if self.harmed == "lossy" and random.random() < 0.3:
            return
        if len(words) == 3 and words[0] == "v":
            try:
                self.ordered = (float(words[1]), float(words[2]))
            except ValueError:
                return
            self.ordered_s = now_s()

    def step(self) -> None:
        """Move for one step."""
        silent = self.due_s - self.ordered_s > self.watchdog_s
        left, right = (0.0, 0.0) if silent else self.ordered
        ahead = (left + right) / 2 * STEP_S
        self.heading += (right - left) / TRACK_M * STEP_S
        self.x += ahead * math.cos(self.heading)
        self.y += ahead * math.sin(self.heading)
        self.ticks[0] += 1.01 * left * STEP_S * TICKS_PER_M
        self.ticks[1] += 0.995 * right * STEP_S * TICKS_PER_M
        self.log.write(json.dumps([self.due_s, self.x, self.y, self.heading, left, right]) + "\n")
        self.due_s += STEP_S

    def read_harm(self) -> None:
        """Do what a test demands."""
        text = self.harm.read_text().strip() if self.harm.exists() else ""
        if text != self.harmed:
            self.harmed = text
            if text.startswith("put"):
                self.x, self.y, self.heading = map(float, text.split()[1:])

    def live(self) -> None:
        """Move until the end of the process, and send the odometry over the link."""
        while True:
            time.sleep(max(0.0, self.due_s - now_s()))
            self.read_harm()
            while self.due_s <= now_s():
                self.step()
            left, right = map(round, self.ticks)
            told = f"o {left} {right}\r\n".encode()
            if self.harmed == "lossy" and random.random() < 0.3:
                told = b"\xff\x00o " + told[: random.randrange(len(told))]
            with suppress(OSError):
                os.write(self.fd, told)

    def run(self, fd: int) -> None:
        """Take the lines at a file descriptor until it breaks."""
        self.fd = fd
        rest = b""
        while True:
            if self.harmed == "deaf":
                time.sleep(STEP_S)
                continue
            if not select.select([fd], [], [], STEP_S)[0]:
                continue
            data = os.read(fd, 4096)
            if not data:
                return
            *lines, rest = (rest + data).split(b"\n")
            for line in lines:
                self.take(line.decode(errors="replace"))


PAINT = np.random.default_rng(5).integers(0, 255, (6, 64, 16, 3), dtype=np.uint8)


def picture(x: float, y: float, heading: float) -> np.ndarray:
    """Return what a camera 0.3 m above the floor sees in the room."""
    columns = (np.arange(WIDTH) + 0.5 - WIDTH / 2) / (0.7 * WIDTH)
    rows = (np.arange(HEIGHT) + 0.5 - HEIGHT / 2) / (0.7 * WIDTH)
    right, down = np.meshgrid(columns, rows)
    to_x = math.cos(heading) + math.sin(heading) * right
    to_y = math.sin(heading) - math.cos(heading) * right
    with np.errstate(divide="ignore", invalid="ignore"):
        reaches = np.stack([
            (WALL_M - y) / to_y, (-WALL_M - y) / to_y, (LENGTH_M - x) / to_x, (-2.0 - x) / to_x, 0.3 / down,
            -2.0 / down,
        ])  # fmt: skip
    reaches[~(reaches > 0)] = np.inf
    surface = reaches.argmin(axis=0)
    reach = reaches.min(axis=0)
    at_x = x + reach * to_x
    at_y = y + reach * to_y
    height = 0.3 - reach * down
    along = np.where((surface == 2) | (surface == 3), at_y + WALL_M, at_x + 2.0)
    across = np.where(surface < 4, height, at_y + WALL_M)
    u = np.clip(along * 4, 0, 63).astype(int)
    v = np.clip(across * 4, 0, 15).astype(int)
    image = cv2.blur(PAINT[surface, u, v], (3, 3))
    noise = np.random.default_rng().integers(0, 6, image.shape, dtype=np.uint8)
    return cv2.add(image, noise)


def serve_camera(base: Base) -> int:
    """Serve the pictures as MJPEG, as small cameras do; return the port."""

    class Pictures(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
            self.end_headers()
            jpeg = b""
            due_s = now_s()
            while True:
                time.sleep(max(0.0, due_s - now_s()))
                due_s += 1 / RATE_HZ
                if base.harmed == "stall":
                    continue
                if base.harmed != "freeze" or not jpeg:
                    jpeg = cv2.imencode(".jpg", picture(base.x, base.y, base.heading))[1].tobytes()
                head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
                try:
                    self.wfile.write(head.encode() + jpeg + b"\r\n")
                except OSError:  # Nobody watches any more.
                    return

        def log_message(self, *_: object) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Pictures)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return server.server_address[1]


def main() -> None:
    """Serve one base."""
    folder = Path(sys.argv[1])
    base = Base(folder, float(sys.argv[3]))
    camera = f"http://127.0.0.1:{serve_camera(base)}/stream"
    if sys.argv[2] == "pty":
        master, slave = pty.openpty()
        tty.setraw(slave)
        print(json.dumps([os.ttyname(slave), camera]), flush=True)
        base.run(master)
        return
    listener = socket.create_server(("127.0.0.1", 0))
    print(json.dumps([f"tcp://127.0.0.1:{listener.getsockname()[1]}", camera]), flush=True)
    while True:
        connection, _ = listener.accept()
        with connection, suppress(OSError):
            base.run(connection.fileno())
        base.fd = -1


if __name__ == "__main__":
    main()
