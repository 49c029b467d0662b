"""``smal`` in this process, and ``smal topic`` as a process that listens."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from schemas.base import Message
from services.cli.main import main
from services.kit.bus import Bus
from tests.services.waiting import eventually

ROOT = Path(__file__).parents[3]
SMAL = [sys.executable, "-c", "from services.cli.main import main; main()"]

Smal = Callable[..., tuple[int, str, str]]
Mistake = Callable[..., str]


@pytest.fixture
def smal(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Smal:
    """Run a command in this process; returns exit status, output and errors, also those of what it starts."""

    def run(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["smal", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        out, err = capfd.readouterr()
        return ended.value.code, out, err

    return run


@pytest.fixture
def mistake(smal: Smal) -> Mistake:
    """Run a command that must end with a status, one line that says why, and no output; returns that line."""

    def run(status: int, *arguments: object) -> str:
        ended, out, err = smal(*arguments)
        assert (ended, out, err.count("\n")) == (status, "", 1), err
        assert err.startswith("smal: ")
        return err

    return run


class Listening:
    """A ``smal topic`` process that listens, and a robot that talks until it has heard something."""

    def __init__(self, client: Bus, *arguments: str) -> None:
        self._client = client
        self.process = subprocess.Popen(
            [*SMAL, "topic", *arguments, "--router", client.endpoint],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        os.set_blocking(self.process.stdout.fileno(), False)

    def lines_until(self, count: int, *messages: Message) -> list[str]:
        """Publish until that many lines have been printed."""
        printed: list[str] = []

        def enough() -> bool:
            for message in messages:
                self._client.publish(message)
            printed.extend(self.process.stdout.readlines())
            return len(printed) >= count

        eventually(enough)
        return printed

    def end(self) -> tuple[int, str, str]:
        """Press Ctrl-C; returns exit status, what was not yet read of the output, and the errors."""
        os.set_blocking(self.process.stdout.fileno(), True)
        self.process.send_signal(signal.SIGINT)
        out, err = self.process.communicate(timeout=100.0)
        return self.process.returncode, out, err


Listen = Callable[..., Listening]


@pytest.fixture
def listen(client: Bus) -> Iterator[Listen]:
    """Start listeners; what still runs after the test is ended."""
    started: list[Listening] = []

    def start(*arguments: str) -> Listening:
        started.append(Listening(client, *arguments))
        return started[-1]

    yield start
    for listening in started:
        listening.process.kill()
        listening.process.communicate()
