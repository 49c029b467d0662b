"""``smal up``: run a whole stack on this machine, without Docker."""

import logging
import re
import sys
import time
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Annotated, Final, NamedTuple

from typer import Option

from services.cli import certificates, options, outputs
from services.cli.stack import GROUPED, Stack, StackPlan, flags
from services.console.config import ConsoleSettings, listen
from services.kit.bus import Router, addresses, host_and_port
from services.kit.credentials import encrypted, how_secure
from services.kit.errors import UsageError
from services.kit.process import configure_logging
from services.kit.settings import fleet
from services.table import role_of, stack_services
from smal.features import FeatureSettings

WATCH_S: Final = 0.5  # Period of the check for ended services, seconds.
LAST_PORT: Final = 65535
MOST_FURTHER: Final = 8  # A quarter of the router's sessions for a stack.
_NONE: Final = "none"
_SIMULATOR: Final = "simulator"
#: Kinds of real bases: each is a service, and an extra of the package.
BASES: Final = ("serial", "ros2")


@dataclass(frozen=True)
class ModelUse(options.Use):
    """Model of recognition and policy."""

    model: Annotated[
        Path | None, Option(help="Model that recognition and policy load at the start.")
    ] = None

    def flags(self) -> tuple[tuple[str, ...], FeatureSettings | None]:
        """Return the flags of recognition and policy, and the features of the model."""
        used = asdict(self)
        if self.model is not None:
            model = options.read_model(self.model, self)
            return flags(**used | {"model": self.model.resolve()}), model.feature_settings
        for name, value in used.items():
            if value is not None:
                raise UsageError(f"--{name} {value}: requires --model")
        return (), None


@dataclass(frozen=True)
class StackFiles:
    """Folders of clients and recorders."""

    root: Annotated[
        Path,
        Option(
            envvar="SMAL_ROOT",
            exists=True,
            file_okay=False,
            help="Folder in which clients may read and write files.",
        ),
    ] = Path()
    recordings: Annotated[Path | None, Option(help="Folder for a recording of every episode.")] = (
        None
    )

    def recordings_of(self, robots: tuple[str, ...]) -> dict[str, Path | None]:
        """Create a folder for each robot; the first robot's folder contains the others."""
        folder = self.recordings
        if folder is None:
            return dict.fromkeys(robots)
        folders = {robot: folder if k == 0 else folder / robot for k, robot in enumerate(robots)}
        for one in folders.values():
            outputs.make_folder(one, "--recordings")
        return {**folders}


@dataclass(frozen=True)
class Ports:
    """Ports of pages and metrics."""

    metrics_port: Annotated[
        int | None, Option(min=1, max=LAST_PORT, help="First port for health and metrics.")
    ] = None
    console: Annotated[
        str, Option(envvar="SMAL_CONSOLE", help="Address of the web page, HOST:PORT, or none.")
    ] = "127.0.0.1:8080"

    def pages(self, robots: tuple[str, ...], root: Path) -> dict[str, str]:
        """Return the address of each robot's page, on consecutive free ports."""
        if self.console == _NONE:
            return {}
        host, _, port = self.console.rpartition(":")
        following = len(robots) if port.isdecimal() else 1
        others = [f"{host}:{int(port) + k}" for k in range(1, following)]
        found = dict(zip(robots, [self.console, *others], strict=True))
        for page in found.values():
            listen(ConsoleSettings(console=page, root=root)).socket.close()
        return found

    def metrics(self, processes: list[str]) -> dict[str, int]:
        """Return the port of each process for health and metrics, on this machine only."""
        if self.metrics_port is None:
            return {}
        if self.metrics_port + len(processes) - 1 > LAST_PORT:
            raise UsageError(
                f"--metrics-port {self.metrics_port}: too large: {len(processes)} processes "
                f"need as many ports (maximum {LAST_PORT})"
            )
        return {name: self.metrics_port + k for k, name in enumerate(processes)}


@dataclass(frozen=True)
class RobotBody:
    """Body of the robot: a simulator, none, a real base with a configuration file, or a module."""

    body: Annotated[
        str,
        Option(
            "--robot-body",
            metavar=f"{_SIMULATOR}|{'|'.join(BASES)}|{_NONE}",
            help="Body of the robot; none for smal replay, a FILE for ros2 with this configuration.",
        ),
    ] = _SIMULATOR
    config: Annotated[
        Path | None,
        Option("--robot-config", help="Configuration file of a real base (serial, ros2)."),
    ] = None

    module: Annotated[
        str | None,
        Option(
            "--robot-module",
            metavar="MODULE",
            help="Python module that runs another body: another simulator, for example.",
        ),
    ] = None

    def other(self) -> str | None:
        """Return the module of another body; UsageError if it is not found."""
        if self.module is None:
            return None
        if self.body != _SIMULATOR or self.config is not None:
            raise UsageError("--robot-module: unsupported with --robot-body and --robot-config")
        places = [str(Path.cwd()), *sys.path]
        if PathFinder.find_spec(self.module.partition(".")[0], places) is None:
            raise UsageError(
                f"--robot-module {self.module}: not found in {Path.cwd()} or among the packages"
            )
        return self.module

    def base(self) -> tuple[str, Path] | None:
        """Return the kind of a real base, and its configuration file."""
        if self.body in BASES:
            if self.config is None:
                raise UsageError(f"--robot-body {self.body}: requires --robot-config FILE")
            return self.body, self.config
        if self.config is not None:
            raise UsageError(
                f"--robot-config: unsupported by --robot-body {self.body}; "
                f"use --robot-body {' or '.join(BASES)}"
            )
        return None if self.body in (_SIMULATOR, _NONE) else ("ros2", Path(self.body))


@dataclass(frozen=True)
class StackSize:
    """Number of robots and instances."""

    robots: options.Robots = 1
    scale: Annotated[
        list[str] | None,
        Option(
            metavar="NAME=N",
            help=f"Instances of a service ({', '.join(GROUPED)}); 0 if they run elsewhere.",
        ),
    ] = None

    @property
    def instances(self) -> dict[str, int]:
        """Instances by service; UsageError if --scale is invalid."""
        found: dict[str, int] = {}
        for text in self.scale or ():
            name, _, many = text.partition("=")
            if name not in GROUPED or not re.fullmatch(r"0|[1-9]\d?", many):
                raise UsageError(
                    f"--scale {text!r}: invalid; expected NAME=N with a NAME of "
                    f"{', '.join(GROUPED)}"
                )
            found[name] = int(many)
        if sum(found.values()) - len(found) > MOST_FURTHER:
            raise UsageError(
                f"--scale: too large: the router has room for {MOST_FURTHER} further instances"
            )
        return found


def up(
    *,
    world: options.World = None,
    learned: ModelUse,
    files: StackFiles,
    simulator: options.Simulator,
    modalities: options.Modalities = None,
    ports: Ports,
    robot_body: RobotBody,
    reach: options.Reach,
    size: StackSize,
    browser: Annotated[
        bool, Option("--browser", help="Page in the browser when the stack is ready.")
    ] = False,
    insecure: Annotated[
        bool, Option("--insecure", help="Access from other machines, without certificates.")
    ] = False,
) -> None:
    """Start all services of a stack and keep them running.

    A service that ends is restarted, with growing delays. Ctrl-C stops everything. With --router
    A,B a router runs at each address; if one fails, the services continue at the other.

    The web page http://127.0.0.1:8080 drives, teaches and monitors the robot. Other terminals can
    use the stack as well: smal teleop, smal topic hz, smal run --connect.

    Clients such as smal run --connect may read models and write recordings below --root, by default
    the current folder. With --metrics-port 9100 the router reports its health on
    http://127.0.0.1:9100/healthz and Prometheus metrics on /metrics, the simulator on 9101, and so
    on.

    With --robots 3 the robots ROBOT-2 and ROBOT-3 have their own simulator, recorder and page (on
    the
    following ports): smal run --connect --robot ROBOT-2. All other services are shared. Of several
    instances (--scale) each serves some robots; if one fails, the others take over within a moment.

    Example: smal up --world campus --model campus.smal
    """
    below = flags(root=files.root.resolve())
    chosen = _chosen_body(robot_body, world, simulator, size, below)
    options.fleet_of(reach.robot, size.robots)
    instances = size.instances
    chain, learned_on = learned.flags()
    features = options.feature_flags(modalities, learned_on)
    left_out = {"console": ports.console == _NONE, "robot": robot_body.body == _NONE}
    services = tuple(name for name in stack_services() if not left_out.get(name))
    access = _check_addresses(reach, services, size.robots, insecure=insecure)
    plan = StackPlan(
        services,
        reach.robot,
        reach.settings.router,
        secure=reach.secure,
        modules=chosen.modules,
        robots=size.robots,
        scale=instances,
    )
    pages = ports.pages(plan.fleet, files.root)
    recorded = files.recordings_of(plan.fleet)
    metrics = ports.metrics(list(plan.processes()))
    of_service = {
        "router": flags(insecure=insecure or None),
        "robot": chosen.flags,
        "features": features,
        "recognition": chain + below,
        "policy": chain + below,
    }
    of_robot = {
        "recorder": {one: flags(recordings=folder) + below for one, folder in recorded.items()},
        "console": {one: flags(console=page) + below for one, page in pages.items()},
    }
    given = {
        name: of_robot.get(service, {}).get(robot, of_service.get(service, ()))
        + (flags(http=f"127.0.0.1:{metrics[name]}") if name in metrics else ())
        for name, (service, robot) in plan.processes().items()
    }
    placed = "without a robot" if left_out["robot"] else f"in {chosen.name}"
    placed += f" on {plan.endpoint}, {access}"
    _run(replace(plan, flags=given), placed, metrics, [*pages.values()], browser=browser)


class _Chosen(NamedTuple):
    """Body of the robot: its name, the module that replaces the simulator, and its flags."""

    name: str
    modules: dict[str, str]
    flags: tuple[str, ...]


def _chosen_body(
    body: RobotBody,
    world: str | None,
    simulator: options.Simulator,
    size: StackSize,
    below: tuple[str, ...],
) -> _Chosen:
    """Return the body, with flags for its root folder; UsageError for options that it does not have."""
    module = body.other()
    base = body.base()
    given = {"world": world, **asdict(simulator)}
    if body.body == _NONE:
        options.refuse(given, f"by --robot-body {_NONE}; leave it out")
        return _Chosen(_NONE, {}, ())
    if module is None and base is None:
        place = world or options.DEFAULT_WORLD
        options.read_world(place)
        return _Chosen(place, {}, (*simulator.flags(place), *below))
    options.refuse(given, f"by {module or body.body}; leave it out")
    if size.robots > 1:
        raise UsageError(f"--robots: unsupported: {module or body.body} is one robot")
    if base is None:
        return _Chosen(str(module), {"robot": str(module)}, ())
    return _Chosen(base_name(*base), {"robot": f"services.{base[0]}"}, flags(robot_config=base[1]))


def _run(
    plan: StackPlan, where: str, metrics: dict[str, int], pages: list[str], *, browser: bool
) -> None:
    """Keep the stack running until Ctrl-C; open its first page if requested."""
    configure_logging("info")
    log = logging.getLogger("up")
    with Stack(plan) as stack:
        log.info("robot %s %s; Ctrl-C stops", ", ".join(plan.fleet), where)
        if metrics:
            ports = ", ".join(f"{name} {port}" for name, port in metrics.items())
            log.info("GET /healthz and /metrics on 127.0.0.1: %s", ports)
        opened = [f"http://{page}" for page in pages]
        log.info("ready: %s", f"open {' and '.join(opened)}" if opened else "without a page")
        if browser and opened:
            outputs.open_page(opened[0])
        with suppress(KeyboardInterrupt):
            while True:
                time.sleep(WATCH_S)
                stack.restart_dead()
    log.info("stopped")


def base_name(kind: str, path: Path) -> str:
    """Return the name of a real base; UsageError if its configuration is invalid."""
    try:
        service = import_module(f"services.{kind}.__main__")
    except ModuleNotFoundError as error:
        raise UsageError(
            f"--robot-body {kind}: package {error.name} not found; pip install -e '.[{kind}]'"
        ) from None
    return str(service.read_config(path).name)


def _check_addresses(
    reach: options.Reach, services: tuple[str, ...], robots: int, *, insecure: bool
) -> str:
    """Check that the router can start and all services can connect; return a note on security."""
    settings = reach.settings
    roles = (*map(role_of, services), "watcher")
    for role in roles:
        settings.credentials(role)
    if reach.secure is not None and encrypted(settings.router):
        certificates.require(reach.secure, roles)
    credentials = settings.credentials("router")
    for address in addresses(settings.router):
        Router(address, credentials, *fleet(reach.robot, robots), insecure=insecure).close()
    return how_secure(
        credentials, *(host_and_port(address)[0] for address in addresses(settings.router))
    )
