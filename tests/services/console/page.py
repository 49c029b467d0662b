"""A page for tests: two sockets, and the actions of a person."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Callable
from contextlib import ExitStack, suppress
from http.client import HTTPConnection
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from schemas.base import KEYS
from services.console.server import WebServer
from tests.services.waiting import DEADLINE_S, eventually


def connected(page: Page) -> socket.socket:
    """Connect to a page's server."""
    host, port = page.address.split(":")
    return socket.create_connection((host, int(port)), timeout=DEADLINE_S)


class Page:
    """Watches as a browser's page does, and drives when it has taken the seat."""

    def __init__(self, server: WebServer) -> None:
        self.address = server.address.removeprefix("http://")
        self.state: dict[str, Any] = {}
        self.pictures: list[bytes] = []
        self.held: Any = None  # What is held, a key or a velocity, and how beats are answered.
        self.answers = True
        self.late_s = 0.0
        self.beats = 0
        self.beat = 0
        self.refusals: list[str] = []
        self.word = ""  # What shows that this page drives.
        self.closed: int | None = None
        self._open = ExitStack()
        self._drive: ClientConnection | None = None
        self._watch = self.open("watch")
        threading.Thread(target=self._look, daemon=True).start()

    def open(self, path: str, **options: Any) -> ClientConnection:
        """Open a socket as the page itself does."""
        own = {"origin": f"http://{self.address}", "close_timeout": 1.0} | options
        return self._open.enter_context(connect(f"ws://{self.address}/{path}", **own))

    def get(self, path: str, **headers: str) -> tuple[int, bytes]:
        """Ask for something by HTTP."""
        connection = HTTPConnection(self.address, timeout=DEADLINE_S)
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.read()

    def post(self, path: str, body: bytes, **headers: str) -> tuple[int, str]:
        """Send something by HTTP as the page does."""
        connection = HTTPConnection(self.address, timeout=DEADLINE_S)
        own = {"Origin": f"http://{self.address}", "Smal-Seat": self.word}
        connection.request("POST", path, body, own | headers)
        answer = connection.getresponse()
        return answer.status, answer.read().decode()

    def take(self) -> None:
        """Sit down."""
        self._drive = self.open("drive")
        threading.Thread(target=self._answer, args=(self._drive,), daemon=True).start()

    def say(self, **what: object) -> None:
        """Send a request of the driver."""
        # Whoever leaves leaves, whenever that comes.
        self._drive.send(
            json.dumps(what if what["do"] in ("leave", "stop") else {"beat": self.beat} | what)
        )

    def insist(self, done: Callable[[], object], **what: object) -> None:
        """Ask until it is done: on a busy machine a page is missed meanwhile, and another stop is latched."""

        def asked() -> bool:
            self.say(**what)
            with suppress(pytest.fail.Exception):
                return bool(eventually(done, timeout_s=3.0))
            return False

        eventually(asked)

    def stop(self) -> None:
        """Press the emergency stop."""
        self._watch.send('{"do": "stop"}')

    def let_go(self) -> None:
        """Let go of the key, and wait until that is heard."""
        self.held = None
        beats = self.beats
        eventually(lambda: self.beats > beats + 2)

    def vanish(self) -> None:
        """Be gone, without a word."""
        self.answers = False
        self._drive.socket.close()

    def robot(self, **wanted: object) -> bool:
        """Whether the page shows the robot so."""
        shown = self.state.get("robot", {})
        return all(shown.get(name) == value for name, value in wanted.items())

    def ailments(self) -> dict[str, str | None]:
        """Return how the page shows every service."""
        return {
            row["name"]: row["ailment"] for row in self.state.get("health", {}).get("services", [])
        }

    def news(self) -> str:
        """Return the news that the page shows."""
        return "\n".join(line["text"] for line in self.state.get("news", []))

    def sit(self) -> None:
        """Sit down, and wait until the robot is heard."""
        self.take()
        eventually(lambda: self.beats > 0 and self.robot(answers=True))

    def begin(self, **what: object) -> None:
        """Sit down, and begin a drive."""
        self.sit()
        self.insist(
            lambda: self.state["robot"]["episode"] is not None,
            **{"do": "drive", "goal": "victim"} | what,
        )

    def close(self) -> None:
        """Close the page."""
        self._open.close()

    def _look(self) -> None:
        try:
            for news in self._watch:
                if isinstance(news, bytes):
                    self.pictures.append(news)
                else:
                    self.state |= json.loads(news)
                    self._watch.send('{"do": "seen"}')
        except ConnectionClosed:
            return

    def _hold_late(self, drive: ClientConnection, hold: str) -> None:
        with suppress(ConnectionClosed, OSError):
            drive.send(hold)

    def _answer(self, drive: ClientConnection) -> None:
        try:
            for text in drive:
                told = json.loads(text)
                if "refused" in told:
                    self.refusals.append(told["refused"])
                    continue
                if "word" in told:
                    self.word = told["word"]
                    continue
                self.beats += 1
                self.beat = told["beat"]
                held = self.held and KEYS.get(self.held, self.held)
                hold = json.dumps({"do": "hold", "beat": told["beat"], "held": held})
                if self.answers and self.late_s:
                    late = threading.Timer(self.late_s, self._hold_late, (drive, hold))
                    late.daemon = True
                    late.start()
                elif self.answers:
                    drive.send(hold)
        except (ConnectionClosed, OSError):
            pass
        self.closed = drive.close_code
