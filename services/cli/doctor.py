"""``smal doctor``: try everything that SMAL needs of this machine; each check says what it found."""

from __future__ import annotations

import json
import shutil
import signal
import socket
import statistics
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import typer
from pydantic import ValidationError

from schemas import topics
from schemas.base import Message, Strict
from schemas.command import Command
from services.cli import options
from services.cli.stack.processes import answers, free_endpoint
from services.kit.bus import Bus, BusError, Router, check_credentials, host_and_port
from services.kit.credentials import how_secure
from services.kit.process import EXIT_FAILED
from services.kit.settings import ServiceSettings
from services.table import stack_services

PYTHONS: Final = ((3, 11), (3, 13))
#: Recordings of a full set of drives, with room for the reports.
DISK_GB: Final = 2.0
RENDER_TIMEOUT_S: Final = 120.0
MESSAGE_TIMEOUT_S: Final = 5.0
MESSAGES: Final = 21


@dataclass(frozen=True)
class Check:
    """What one check found; ``text`` says in a problem what to do as well."""

    name: str
    ok: bool
    text: str


def doctor(*, as_json: options.Json = False, reach: options.Reach) -> None:
    """Check rendering, Zenoh, the router's port, Python and disk space; says what to install.

    Example: smal doctor
    """
    results = []
    settings = reach.settings
    for check in (check_python, check_disk, check_zenoh, lambda: check_port(settings), check_rendering):
        results.append(check())
        if not as_json:
            typer.echo(f"{'ok' if results[-1].ok else 'problem':8} {results[-1].name:10} {results[-1].text}")
    if as_json:
        typer.echo(json.dumps([asdict(result) for result in results], indent=2))
    if not all(result.ok for result in results):
        raise typer.Exit(EXIT_FAILED)


class _ProbeAnswer(Strict):
    error: str | None = None
    driver: str = ""
    software: bool = True
    seconds: float = 0.0


def check_python() -> Check:
    """Look at the version of Python."""
    version = sys.version_info[:2]
    found = f"Python {version[0]}.{version[1]}"
    if PYTHONS[0] <= version <= PYTHONS[1]:
        return Check("python", True, found)
    return Check("python", False, f"{found}; use 3.11, 3.12 or 3.13: python3.13 -m venv .venv")


def check_rendering(command: tuple[str, ...] = (sys.executable, "-m", "services.simulator.scene.probe")) -> Check:
    """Render a tiny frame in a process of its own, which a broken driver may crash."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=RENDER_TIMEOUT_S, check=False)  # noqa: S603
    except subprocess.TimeoutExpired:
        return Check("rendering", False, f"no frame within {RENDER_TIMEOUT_S:.0f} s; try another Vulkan driver")
    if done.returncode < 0:
        name = signal.Signals(-done.returncode).name
        text = f"the Vulkan driver crashed ({name}); update it, or install Mesa 24.3 or newer"
        return Check("rendering", False, text)
    try:
        answer = _ProbeAnswer.model_validate_json((done.stdout.strip().splitlines() or [""])[-1])
    except ValidationError:
        reason = (done.stderr.strip().splitlines() or ["it said nothing"])[-1]
        return Check("rendering", False, f"the renderer failed: {reason}; install with deploy/setup.sh")
    if answer.error is not None:
        return Check("rendering", False, answer.error)
    kind = "software, on the CPU" if answer.software else "GPU"
    return Check("rendering", True, f"{answer.driver} ({kind}); first frame after {answer.seconds} s")


def check_zenoh() -> Check:
    """Send messages from one client to another, through a router of this check's own."""
    endpoint = free_endpoint()
    try:
        with ExitStack() as stack:
            stack.enter_context(closing(Router(endpoint)))
            sender, receiver = (stack.enter_context(closing(Bus("doctor", endpoint))) for _ in range(2))
            arrived = threading.Event()
            receiver.subscribe(topics.COMMANDS["teleop"], lambda *_sample: arrived.set())
            times_s = [_time_message(sender, arrived, sequence) for sequence in range(MESSAGES)]
    except BusError as error:
        return Check("zenoh", False, str(error))
    except TimeoutError:
        return Check("zenoh", False, f"no message within {MESSAGE_TIMEOUT_S:.0f} s; does a firewall block 127.0.0.1?")
    return Check("zenoh", True, f"a message through a router takes {1e3 * statistics.median(times_s[1:]):.2f} ms")


def _time_message(sender: Bus, arrived: threading.Event, sequence: int) -> float:
    """Return the time from sending to arrival; the first message is repeated until the subscription is known."""
    header = Message(robot="doctor", episode="doctor", tick=0, stamp_ns=0)
    message = Command.after(header, source="teleop", sequence=sequence, atom="stop")
    arrived.clear()
    deadline = time.monotonic() + MESSAGE_TIMEOUT_S
    while time.monotonic() < deadline:
        begin_s = time.monotonic()
        sender.publish(message)
        if arrived.wait(0.05):
            return time.monotonic() - begin_s
    raise TimeoutError


def check_port(settings: ServiceSettings) -> Check:
    """Look who listens on the router's port: nobody, a running stack, or somebody else; and who gets in there."""
    endpoint, robot = settings.router, settings.robot
    try:
        host, port = host_and_port(endpoint)
        credentials = settings.credentials("watcher")
        check_credentials(endpoint, credentials)
    except BusError as error:
        return Check("port", False, str(error))
    try:
        socket.create_connection((host, port), 1.0).close()
    except ConnectionRefusedError:
        return Check("port", True, f"{endpoint} is free, {how_secure(credentials, host)}")
    except OSError as error:
        return Check("port", False, f"{endpoint}: {error}; give another with --router or SMAL_ROUTER")
    elsewhere = (
        f"if it should not be there, stop it (ss -ltnp 'sport = :{port}' names it), or set SMAL_ROUTER to another port"
    )
    try:
        with closing(settings.open_bus("watcher", patience_s=1.0)) as bus:
            running = [service for service in stack_services() if answers(bus, service) is not None]
    except BusError as error:
        return Check("port", False, f"{error}; {elsewhere}")
    if not running:
        return Check("port", False, f"{endpoint} is used by a Zenoh router without services of {robot}; {elsewhere}")
    who = how_secure(credentials)
    return Check("port", True, f"{endpoint} is used by the running stack of {robot}, {who}: {', '.join(running)}")


def check_disk() -> Check:
    """Look how much room is left for recordings."""
    folder = Path.cwd()
    free_gb = shutil.disk_usage(folder).free / 1e9
    if free_gb >= DISK_GB:
        return Check("disk", True, f"{free_gb:.0f} GB free in {folder}")
    return Check("disk", False, f"{free_gb:.1f} GB free in {folder}; make room for {DISK_GB:.0f} GB of recordings")
