"""Processes of a stack on this machine: started, supervised and stopped together."""

import logging
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Self

from schemas.rpc import Nothing, Status
from services.cli.child import tied
from services.kit.bus import Bus, BusError, RpcError, addresses
from services.kit.errors import JobError
from services.kit.settings import ServiceSettings, fleet
from services.table import SERVICES

STOP_TIMEOUT_S: Final = 5.0
# Least time between two starts of a service, doubled with every death, seconds.
FIRST_S = 1.0
LONGEST_S = 30.0
STEADY_S: Final = 60.0  # Lifetime after which a service counts as healthy again, seconds.
# A slow machine builds a large world in minutes.
PATIENCE_S: Final = 600.0
_TELL_S: Final = 10.0
#: Services of which one instance serves several robots.
GROUPED: Final = tuple(service.name for service in SERVICES.values() if service.grouped)
#: Environment variables for the certificate, which differs between services of a stack.
_KEYS: Final = ("SMAL_SECURE", "SMAL_TLS_CA", "SMAL_TLS_CERT", "SMAL_TLS_KEY")
#: By service and instance, the robots served.
Instances = dict[str, dict[str, list[str]]]
_log = logging.getLogger("stack")


def free_endpoint() -> str:
    """Return the address of a free port on this machine for a router."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def flags(**values: object) -> tuple[str, ...]:
    """Convert keyword arguments to command line flags; omit None."""
    given = {name: str(value) for name, value in values.items() if value is not None}
    return tuple(
        part for name, value in given.items() for part in (f"--{name.replace('_', '-')}", value)
    )


def routers_at(endpoint: str) -> dict[str, str]:
    """Return the addresses of a stack's routers (comma-separated) by process name."""
    return {
        f"router-{k}" if k > 1 else "router": address
        for k, address in enumerate(addresses(endpoint), 1)
    }


@dataclass(frozen=True)
class StackPlan:
    """Services of a stack and their settings."""

    services: tuple[str, ...]  # Names of `services.table`, the router first.
    robot: str
    # Addresses of the stack's own routers, comma-separated; a router starts at each.
    endpoint: str
    # Command line flags by service.
    flags: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    # Folder of certificates; without it, access is open to anyone who reaches the router.
    secure: Path | None = None
    # Folder for one log file per service; None logs to this terminal.
    logs: Path | None = None
    # Each robot has its own body, recorder and page; grouped services serve all robots.
    robots: int = 1
    # Number of instances of grouped services, by default 1.
    scale: Mapping[str, int] = field(default_factory=dict)
    #: Modules that replace those of a process, for example another body of the first robot.
    modules: Mapping[str, str] = field(default_factory=dict)

    @property
    def fleet(self) -> tuple[str, ...]:
        """The robots."""
        return fleet(self.robot, self.robots)

    def processes(self) -> dict[str, tuple[str, str]]:
        """Return the service and robot of each process; names are numbered from the second on."""
        found = {}
        for service in self.services:
            many = (
                len(routers_at(self.endpoint))
                if service == "router"
                else self.scale.get(service, 1)
            )
            of_each = service != "router" and not SERVICES[service].grouped
            whose = self.fleet if of_each else (self.robot,) * many
            for number, robot in enumerate(whose, 1):
                found[service if number == 1 else f"{service}-{number}"] = service, robot
        return found


@dataclass
class _Child:
    """Process of a service, its start time, and the minimum time to the next start."""

    process: subprocess.Popen[bytes]
    began_s: float
    spacing_s: float
    mourned: bool = False


def next_spacing_s(spacing_s: float, lived_s: float) -> float:
    """Return the minimum time to the start after next, which doubles when a service keeps ending."""
    return FIRST_S if lived_s >= STEADY_S else min(2.0 * spacing_s, LONGEST_S)


class Stack:
    """Context manager for the services of a stack as child processes."""

    def __init__(self, plan: StackPlan) -> None:
        self.plan = plan
        self._routers = routers_at(plan.endpoint)
        self._processes = plan.processes()
        self._children: dict[str, _Child] = {}

    @property
    def settings(self) -> ServiceSettings:
        """The settings of the connection, without the certificate of the environment."""
        return ServiceSettings(
            robot=self.plan.robot,
            router=self.plan.endpoint,
            secure=self.plan.secure,
            tls_ca=None,
            tls_cert=None,
            tls_key=None,
        )

    def __enter__(self) -> Self:
        try:
            for router in self._routers:
                self._start(router)
            # Otherwise a slow router exceeds the connection timeout of the other services.
            with closing(self._reach_routers()) as bus, ExitStack() as opened:
                buses = {
                    robot: opened.enter_context(closing(bus.of_robot(robot)))
                    for robot in self.plan.fleet
                }

                def is_ready(process: str) -> bool:
                    service, robot = self._processes[process]
                    if SERVICES[
                        service
                    ].grouped:  # Any instance can answer; every robot must be served.
                        told = [
                            answers(one, service) for one in buses.values() if process == service
                        ]
                    else:
                        told = [answers(buses[robot], service)]
                    return all(one is not None and one.state == "ready" for one in told)

                for process in [name for name in self._processes if name not in self._routers]:
                    self._start(process)
                self._wait(tuple(self._processes), is_ready)
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(self, *_error: object) -> None:
        self.stop()

    def check(self) -> None:
        """Raise JobError with the last line of its log if a service has ended."""
        for service in self._dead():
            raise JobError(self._epitaph(service))

    def pid(self, service: str) -> int:
        """Return the process id of a service or router (`routers_at`)."""
        return self._children[service].process.pid

    def restart_dead(self) -> list[str]:
        """Restart services that have ended, with growing delays, and return their names."""
        started = []
        for service in self._dead():
            child = self._children[service]
            lived_s = time.monotonic() - child.began_s
            wait_s = max(0.0, child.spacing_s - lived_s)
            if not child.mourned:
                child.mourned = True
                when = f"in {wait_s:.1f} s" if wait_s else "now"
                _log.warning("%s; restarting %s", self._epitaph(service), when)
            if not wait_s:
                self._start(service, next_spacing_s(child.spacing_s, lived_s))
                started.append(service)
        return started

    def stop(self) -> None:
        """Stop every service, routers last; kill a service after five seconds."""
        routers = [service for service in self._children if service in self._routers]
        for group in ([service for service in self._children if service not in routers], routers):
            for service in group:
                self._children[service].process.send_signal(signal.SIGTERM)
            deadline = time.monotonic() + STOP_TIMEOUT_S
            for process in (self._children[service].process for service in group):
                try:
                    process.wait(max(0.1, deadline - time.monotonic()))
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()
        self._children.clear()

    def _start(self, process: str, spacing_s: float = FIRST_S) -> None:
        plan = self.plan
        (service, robot) = self._processes[process]
        environment = {name: value for name, value in os.environ.items() if name not in _KEYS}
        environment |= {
            "SMAL_ROBOT": robot,
            "SMAL_ROBOTS": str(plan.robots),
            "SMAL_ROUTER": plan.endpoint,
        }
        if plan.secure is not None:
            environment["SMAL_SECURE"] = str(plan.secure.resolve())
        if process in self._routers:
            routers = [*self._routers.values()] if len(self._routers) > 1 else []
            further = environment.get("SMAL_PEERS")  # Routers on other machines.
            peers = ",".join([*([further] if further else []), *routers])
            environment |= {"SMAL_ROUTER": self._routers[process], "SMAL_PEERS": peers}
        module = plan.modules.get(process)
        program = SERVICES[service].command if module is None else ("-m", module)
        command = tied(
            sys.executable, *program, *plan.flags.get(process, plan.flags.get(service, ()))
        )
        if plan.logs is not None:
            plan.logs.mkdir(parents=True, exist_ok=True)
        # A session of its own, so that Ctrl-C reaches this process alone; `tied` ends the child.
        with (
            nullcontext() if plan.logs is None else (plan.logs / f"{process}.log").open("ab") as log
        ):
            child = subprocess.Popen(  # noqa: S603
                command, env=environment, stdout=log, stderr=log, start_new_session=True
            )
        self._children[process] = _Child(child, time.monotonic(), spacing_s)

    def _reach_routers(self) -> Bus:
        """Connect to each router; fail at once if a router ends."""
        reached: dict[str, Bus] = {}

        def is_reached(router: str) -> bool:
            with suppress(BusError):
                at = self.settings.model_copy(update={"router": self._routers[router]})
                reached[router] = at.open_bus("watcher", patience_s=0.0)
            return router in reached

        self._wait(tuple(self._routers), is_reached)
        bus, *others = reached.values()
        for other in others:
            other.close()
        return bus

    def _wait(self, services: Sequence[str], is_ready: Callable[[str], object]) -> None:
        """Wait until services are ready; log the pending services and the last lines of their logs."""
        began_s = told_s = time.monotonic()
        while services := [service for service in services if not is_ready(service)]:
            self.check()
            now_s = time.monotonic()
            lines = {service: self._last_line(service) for service in services}
            doing = [f"{service}{line and f' ({line})'}" for service, line in lines.items()]
            if now_s - began_s > PATIENCE_S:
                raise JobError(f"not ready after {now_s - began_s:.0f} s: {', '.join(doing)}")
            if now_s - told_s >= _TELL_S:
                told_s = now_s
                _log.warning("waiting for %.0f s for %s", now_s - began_s, ", ".join(doing))
            # Poll less often over time: answering takes work as well.
            time.sleep(max(0.05, (now_s - began_s) / 50.0))

    def _dead(self) -> list[str]:
        return [
            service for service, child in self._children.items() if child.process.poll() is not None
        ]

    def _epitaph(self, service: str) -> str:
        status = self._children[service].process.returncode
        if status < 0:
            return f"{service} was killed by {signal.Signals(-status).name}"
        return f"{service}: {self._last_line(service) or f'ended with status {status}'}"

    def _last_line(self, service: str) -> str:
        """Return the last line of a service's log; "" if it logs to this terminal."""
        if self.plan.logs is None:
            return ""
        lines = (self.plan.logs / f"{service}.log").read_text(errors="replace").strip().splitlines()
        return lines[-1].split(f" {service}: ", 1)[-1] if lines else ""


def answers(bus: Bus, service: str) -> Status | None:
    """Return the status of a service, or None if it does not answer."""
    try:
        return bus.call(service, "status", Nothing(), Status, timeout_s=1.0, patience_s=0.0)
    except RpcError:
        return None


def instances(bus: Bus) -> Instances:
    """Return the robots that each running instance of each grouped service serves."""
    router = answers(bus, "router")
    robots = fleet(bus.robot, int(router.detail.get("robots") or 1)) if router is not None else ()
    found: Instances = {}
    for robot in robots:
        with closing(bus.of_robot(robot)) as one:
            for service in GROUPED:
                if (told := answers(one, service)) is not None:
                    found.setdefault(service, {}).setdefault(
                        str(told.detail.get("instance")), []
                    ).append(robot)
    return found


@dataclass(frozen=True)
class Access:
    """A usable stack."""

    settings: ServiceSettings
    check: Callable[[], None]  # Raises JobError if a process of the stack has ended.
    logs: Path | None  # Folder of the services' logs; None for a stack that ran before.


@contextmanager
def stack_for(
    running: ServiceSettings | None,
    services: tuple[str, ...],
    robot: str,
    service_flags: Mapping[str, tuple[str, ...]],
    logs: Path | None = None,
) -> Iterator[Access]:
    """Connect to a running stack, or start a temporary stack that only this machine can reach."""
    if running is not None:
        yield Access(running, lambda: None, None)
        return
    logs = logs or Path(tempfile.mkdtemp(prefix="smal-logs-"))
    with Stack(StackPlan(services, robot, free_endpoint(), service_flags, logs=logs)) as stack:
        yield Access(stack.settings, stack.check, logs)
