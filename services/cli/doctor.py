"""``smal doctor``: check the requirements of SMAL on this machine."""

import json
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path
from typing import Annotated, Final

import typer
from pydantic import ValidationError
from typer import Option

from schemas import topics
from schemas.base import Strict
from schemas.command import Command
from services.cli import options
from services.cli.stack import GROUPED, Instances, answers, free_endpoint, instances
from services.kit.bus import Bus, BusError, Router, addresses, check_credentials, host_and_port
from services.kit.credentials import how_secure
from services.kit.errors import JobError, UsageError
from services.kit.process import EXIT_FAILED
from services.kit.settings import ServiceSettings, fleet
from services.table import stack_services

PYTHONS: Final = ((3, 11), (3, 13))
DISK_GB: Final = 2.0  # A full set of drives, with room for the reports.
RENDER_TIMEOUT_S: Final = 120.0
MESSAGE_TIMEOUT_S: Final = 5.0


def doctor(
    *,
    as_json: options.Json = False,
    reach: options.Reach,
    robot_config: Annotated[
        Path | None,
        Option(help="Configuration of a serial or network base, whose inputs are checked."),
    ] = None,
) -> None:
    """Check rendering, Zenoh, the router's port, Python and disk space.

    With --robot-config, check a base without ROS as well: save a picture of its camera, measure the
    pictures' rate and age, send a stop, and read the odometry. The base must not be in use.

    Each problem comes with its remedy. The exit status is 1 if there is a problem.

    Example: smal doctor
    """
    checks: dict[str, Callable[[], str]] = {
        "python": check_python,
        "disk": check_disk,
        "zenoh": check_zenoh,
        "port": partial(check_port, reach.settings),
        "rendering": check_rendering,
        **_checks_of_base(robot_config),
    }
    results = []
    for name, check in checks.items():
        try:
            one = {"name": name, "ok": True, "text": check()}
        except JobError as problem:
            one = {"name": name, "ok": False, "text": str(problem)}
        results.append(one)
        if not as_json:
            typer.echo(f"{'ok' if one['ok'] else 'problem':8} {name:10} {one['text']}")
    if as_json:
        typer.echo(json.dumps(results, indent=2))
    if not all(one["ok"] for one in results):
        raise typer.Exit(EXIT_FAILED)


def _checks_of_base(path: Path | None) -> dict[str, Callable[[], str]]:
    """Return the checks of a base without ROS; UsageError if its configuration is invalid."""
    if path is None:
        return {}
    try:
        from services.serial.checks import checks  # noqa: PLC0415 - only this needs its packages
        from services.serial.config import read_config  # noqa: PLC0415
    except ModuleNotFoundError as error:
        raise UsageError(
            f"--robot-config {path}: package {error.name} not found; pip install -e '.[serial]'"
        ) from None
    return checks(read_config(path))


class _ProbeAnswer(Strict):
    error: str | None = None
    driver: str = ""
    software: bool = True
    seconds: float = 0.0


def check_python() -> str:
    """Check the version of Python."""
    found = f"Python {sys.version_info[0]}.{sys.version_info[1]}"
    if not PYTHONS[0] <= sys.version_info[:2] <= PYTHONS[1]:
        raise JobError(f"{found}: unsupported; use 3.11, 3.12 or 3.13: python3.13 -m venv .venv")
    return found


def check_rendering(
    command: tuple[str, ...] = (sys.executable, "-m", "services.simulator.scene.probe"),
) -> str:
    """Render a tiny frame in a separate process, which a faulty driver can crash."""
    try:
        done = subprocess.run(  # noqa: S603
            command, capture_output=True, text=True, timeout=RENDER_TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired:
        raise JobError(
            f"no frame after {RENDER_TIMEOUT_S:.0f} s; try another Vulkan driver"
        ) from None
    if done.returncode < 0:
        name = signal.Signals(-done.returncode).name
        raise JobError(
            f"the Vulkan driver crashed ({name}); update it, or install Mesa 24.3 or newer"
        )
    try:
        answer = _ProbeAnswer.model_validate_json((done.stdout.strip().splitlines() or [""])[-1])
    except ValidationError:
        reason = (done.stderr.strip().splitlines() or ["no output"])[-1]
        raise JobError(f"the renderer failed: {reason}; install with deploy/setup.sh") from None
    if answer.error is not None:
        raise JobError(answer.error)
    kind = "software, on the CPU" if answer.software else "GPU"
    return f"{answer.driver} ({kind}); first frame after {answer.seconds} s"


def check_zenoh() -> str:
    """Send a message between two clients through a temporary router."""
    endpoint = free_endpoint()
    arrived = threading.Event()
    message = Command(
        robot="doctor",
        episode="doctor",
        tick=0,
        stamp_ns=0,
        source="teleop",
        linear=0.0,
        angular=0.0,
    )
    with ExitStack() as stack:
        stack.enter_context(closing(Router(endpoint)))
        sender, receiver = (stack.enter_context(closing(Bus("doctor", endpoint))) for _ in range(2))
        receiver.subscribe(topics.COMMANDS["teleop"], lambda *_sample: arrived.set())
        deadline_s = time.monotonic() + MESSAGE_TIMEOUT_S
        # Repeat until the subscription is active.
        while not arrived.wait(0.05):
            if time.monotonic() > deadline_s:
                raise JobError(
                    f"no message after {MESSAGE_TIMEOUT_S:.0f} s; check that the firewall "
                    "allows 127.0.0.1"
                )
            sender.publish(message)
    return "message delivered through a router"


def check_port(settings: ServiceSettings) -> str:
    """Check that the router's port is free or used by a stack that accepts this machine."""
    endpoint = settings.router
    credentials = settings.credentials("watcher")
    check_credentials(endpoint, credentials)
    free = [address for address in addresses(endpoint) if _is_free(address)]
    if ",".join(free) == endpoint:
        return f"{endpoint} is free, {how_secure(credentials, *(host_and_port(address)[0] for address in free))}"
    if free:
        raise JobError(f"router not found at {', '.join(free)} while others run; start it")
    port = host_and_port(addresses(endpoint)[0])[1]
    elsewhere = (
        f"stop that process (ss -ltnp 'sport = :{port}'), or set SMAL_ROUTER to another port"
    )
    try:
        running, shared = _running(settings)
    except BusError as error:
        raise JobError(f"{error}; {elsewhere}") from None
    if not running:
        raise JobError(
            f"{endpoint} is used by a Zenoh router without services of {settings.robot}; "
            f"{elsewhere}"
        )
    stack = f"the running stack of {settings.robot}, {how_secure(credentials)}"
    found = [f"{endpoint} is used by {stack}: {', '.join(running)}"]
    alone = all(served == [settings.robot] for by in shared.values() for served in by.values())
    for service, by in ({} if alone else shared).items():
        served = (f"{instance} serves {' '.join(robots)}" for instance, robots in by.items())
        found.append(f"{service}: {', '.join(served)}")
    return "; ".join(found)


def _is_free(address: str) -> bool:
    try:
        socket.create_connection(host_and_port(address), 1.0).close()
    except ConnectionRefusedError:
        return True
    except OSError as error:
        raise JobError(f"{address}: {error}; choose another with --router or SMAL_ROUTER") from None
    return False


def _running(settings: ServiceSettings) -> tuple[list[str], Instances]:
    """Return the running services and instances; check that the instances serve all robots."""
    with closing(settings.open_bus("watcher", patience_s=1.0)) as bus:
        running = [service for service in stack_services() if answers(bus, service) is not None]
        shared = instances(bus)
        router = answers(bus, "router")
    if running and router is not None:
        robots = fleet(settings.robot, int(router.detail.get("robots") or 1))
        check_served(robots, {service: shared.get(service, {}) for service in GROUPED})
    return running, shared


def check_served(robots: Sequence[str], shared: Mapping[str, Mapping[str, Sequence[str]]]) -> None:
    """Check that each running shared service serves every robot.

    Services without any instance run on another machine, or are left out on purpose.
    """
    unserved = [
        f"{robot} by no instance of {service}"
        for service, by in shared.items()
        for robot in robots
        if by and all(robot not in served for served in by.values())
    ]
    if unserved:
        raise JobError(
            f"not served: {', '.join(unserved)}; start an instance, or see /healthz of the "
            "running ones (--http)"
        )


def check_disk() -> str:
    """Check the free disk space for recordings."""
    folder = Path.cwd()
    free_gb = shutil.disk_usage(folder).free / 1e9
    if free_gb < DISK_GB:
        raise JobError(f"{free_gb:.1f} GB free in {folder}; recordings need {DISK_GB:.0f} GB")
    return f"{free_gb:.0f} GB free in {folder}"
