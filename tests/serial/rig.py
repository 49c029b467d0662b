"""A fake base, a link that a test may harm, and the service that drives the base."""

import json
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from typing import Any

from schemas import topics
from schemas.base import Atom
from schemas.camera import CompressedImage
from schemas.codec import decode
from schemas.command import Command
from services.cli.stack import free_endpoint
from services.kit.bus import Bus, Router
from tests.serial.fake_base import TICKS_PER_M, TRACK_M, now_s
from tests.services.real_base import DrivenBase

WATCHDOG_S = 0.2
SPEED_M_S = 0.4


class FakeBase:
    """The process of a fake base, and its log."""

    def __init__(self, folder: Path, kind: str) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder
        command = [sys.executable, "-m", "tests.serial.fake_base", folder, kind, str(WATCHDOG_S)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        self.address, self.camera = json.loads(self.process.stdout.readline())

    def harm(self, text: str) -> None:
        """Change the base, see `tests.serial.fake_base`."""
        (self.folder / "harm").write_text(text)

    def steps(self, since_s: float) -> list[list[float]]:
        """Return the steps of the wheels: time, x, y, heading, left and right speed."""
        lines = (self.folder / "steps.jsonl").read_text().splitlines()
        return [step for step in map(json.loads, lines[-3000:-1]) if step[0] >= since_s]

    def moved_s(self, since_s: float) -> float:
        """Return how long after a time the wheels last turned."""
        return max((s[0] - since_s for s in self.steps(since_s) if s[4] or s[5]), default=0.0)

    @property
    def moving(self) -> bool:
        """Whether the wheels turn."""
        steps = self.steps(now_s() - 0.1)
        return bool(steps) and bool(steps[-1][4] or steps[-1][5])

    def close(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.wait()


class Proxy:
    """A TCP link to an address that delays and loses what it carries."""

    def __init__(self, address: str) -> None:
        host, _, port = address.rpartition("//")[2].rpartition(":")
        self._there = (host, int(port))
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self.latency_s = 0.0
        self.cut = False
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                near, _ = self._listener.accept()
                far = socket.create_connection(self._there)
                for pair in ((near, far), (far, near)):
                    threading.Thread(target=self._carry, args=pair, daemon=True).start()

    def _carry(self, source: socket.socket, target: socket.socket) -> None:
        waiting: deque[tuple[float, bytes]] = deque()
        with suppress(OSError):
            while True:
                # A cut link carries nothing, and keeps what TCP would repeat.
                if not self.cut and select.select([source], [], [], 0.002)[0]:
                    data = source.recv(4096)
                    if not data:
                        break
                    waiting.append((time.monotonic() + self.latency_s, data))
                while waiting and waiting[0][0] <= time.monotonic() and not self.cut:
                    target.sendall(waiting.popleft()[1])
                time.sleep(0.002)
        for one in (source, target):
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)


def config_of(base: FakeBase, address: str, **more: Any) -> dict[str, Any]:
    """Return the configuration of a fake base."""
    told: dict[str, Any] = {
        "name": "fake", "speed_m_s": SPEED_M_S, "turn_rate_rad_s": 0.8, "braking_s": 0.0, "watchdog_s": WATCHDOG_S,
        "camera": {"source": base.camera, "latency_s": 0.0},
        "base": {"address": address, "velocity": "v {left_m_s:.3f} {right_m_s:.3f}", "track_m": TRACK_M},
        "odometry": {"line": f"o {{left_m*{TICKS_PER_M}}} {{right_m*{TICKS_PER_M}}}"},
    }  # fmt: skip
    return told | more


class Driven(DrivenBase):
    """A fake base, the service that drives it, and a driver that answers each picture."""

    def __init__(self, base: FakeBase, config: dict[str, Any], endpoint: str, bus: Bus) -> None:
        self.base = base
        self.path = base.folder / "mine.yaml"
        self.path.write_text(json.dumps(config))  # JSON is YAML.
        self.endpoint = endpoint
        self.bus = bus
        self.atom: Atom | None = "left"
        self.process = self.start()

    def start(self) -> subprocess.Popen[bytes]:
        """Start the service."""
        flags = f"--router {self.endpoint} --robot fake --attended false --robot-config {self.path}"
        with (self.base.folder / "robot.log").open("ab") as log:
            command = [sys.executable, "-m", "services.serial", *flags.split()]
            self.process = subprocess.Popen(command, stdout=log, stderr=log)
        return self.process

    def answer(self, payload: bytes, encoding: str, _transit_s: float | None) -> None:
        """Answer a picture."""
        if self.atom is not None:
            image = decode(CompressedImage, payload, encoding)
            self.bus.publish(Command.after(image, source="expert", atom=self.atom))

    @property
    def moving(self) -> bool:
        """Whether the wheels turn."""
        return self.base.moving


@contextmanager
def driven(base: FakeBase, config: dict[str, Any]) -> Iterator[Driven]:
    """Drive a fake base."""
    with ExitStack() as stacked:
        endpoint = free_endpoint()
        stacked.callback(Router(endpoint).close)
        bus = stacked.enter_context(closing(Bus("fake", endpoint)))
        one = Driven(base, config, endpoint, bus)
        bus.subscribe(topics.JPEG, one.answer)
        try:
            yield one
        finally:
            one.process.send_signal(signal.SIGCONT)
            one.process.kill()
            one.process.wait()
