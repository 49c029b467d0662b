"""``smal up``: the whole stack on this machine, without Docker."""

import logging
import re
import time
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Final

from typer import Option

from services.cli import certificates, options, outputs
from services.cli.options import CameraOptions
from services.cli.stack import GROUPED, Stack, StackPlan, flags
from services.console.config import ConsoleSettings, listen
from services.kit.bus import Router, addresses, host_and_port
from services.kit.credentials import encrypted, how_secure
from services.kit.errors import UsageError
from services.kit.process import configure_logging
from services.kit.settings import fleet
from services.table import role_of, stack_services
from smal.features import FeatureSettings

WATCH_S: Final = 0.5  # Period of the search for dead services, seconds.
CAMERA: Final = CameraOptions(640, 480)
LAST_PORT: Final = 65535
MOST_FURTHER: Final = 8  # A quarter of the router's sessions that are for a stack.
_NONE: Final = "none"
_SIMULATOR: Final = "simulator"


@dataclass(frozen=True)
class ModelUse(options.Use):
    """The model of recognition and policy."""

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
                raise UsageError(f"--{name} {value}: needs --model")
        return (), None


@dataclass(frozen=True)
class StackFiles:
    """Where clients and recorders read and write."""

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
        """Make the folder of each robot, the first robot's above the others'."""
        folder = self.recordings
        if folder is None:
            return dict.fromkeys(robots)
        folders = {robot: folder if k == 0 else folder / robot for k, robot in enumerate(robots)}
        for one in folders.values():
            outputs.make_folder(one, "--recordings")
        return {**folders}


@dataclass(frozen=True)
class Ports:
    """Where pages and metrics are."""

    metrics_port: Annotated[
        int | None, Option(min=1, max=LAST_PORT, help="First of the ports for health and metrics.")
    ] = None
    console: Annotated[
        str, Option(envvar="SMAL_CONSOLE", help="Address of the web page, HOST:PORT, or none.")
    ] = "127.0.0.1:8080"

    def pages(self, robots: tuple[str, ...], root: Path) -> dict[str, str]:
        """Return the address of each robot's page, at ports that follow; check that each is free."""
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
                f"--metrics-port {self.metrics_port}: {len(processes)} processes need as many ports"
            )
        return {name: self.metrics_port + k for k, name in enumerate(processes)}


@dataclass(frozen=True)
class StackSize:
    """How many robots and instances there are."""

    robots: options.Robots = 1
    scale: Annotated[
        list[str] | None,
        Option(metavar="NAME=N", help=f"Instances of one of {', '.join(GROUPED)}; 0: elsewhere."),
    ] = None

    @property
    def instances(self) -> dict[str, int]:
        """Instances by service; UsageError when --scale is invalid."""
        found: dict[str, int] = {}
        for text in self.scale or ():
            name, _, many = text.partition("=")
            if name not in GROUPED or not re.fullmatch(r"0|[1-9]\d?", many):
                raise UsageError(
                    f"--scale {text!r}: expected NAME=N, with a NAME of {', '.join(GROUPED)}"
                )
            found[name] = int(many)
        if sum(found.values()) - len(found) > MOST_FURTHER:
            raise UsageError(
                f"--scale: the router has room for {MOST_FURTHER} further instances in all"
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
    body: Annotated[
        str,
        Option(
            "--robot-body",
            metavar=f"{_SIMULATOR}|{_NONE}|FILE",
            help="Body of the robot: FILE configures a ROS 2 base; none is for smal replay.",
        ),
    ] = _SIMULATOR,
    reach: options.Reach,
    size: StackSize,
    insecure: Annotated[
        bool, Option("--insecure", help="Access for everybody, from other machines too.")
    ] = False,
) -> None:
    """Start the services, from the router to the recorder, and keep them running.

    A service that ends is started again, one that keeps ending less and less often. Ctrl-C ends everything cleanly.
    Of several addresses, --router A,B, each has a router: where one is killed or frozen, all go on at the other.
    A browser drives, teaches and watches it at http://127.0.0.1:8080; other terminals use it as well: smal teleop, smal
    topic hz, smal run --connect.

    Clients of the stack, such as smal run --connect, may have models read and recordings written below --root, by
    default the current folder. With --metrics-port 9100 the router tells its health on http://127.0.0.1:9100/healthz
    and what Prometheus wants on /metrics, the simulator on 9101, and so on.

    With --robots 3 there are ROBOT-2 and ROBOT-3 as well, each with its own simulator, recorder and page (at the ports
    that follow): smal run --connect --robot ROBOT-2. All other services serve them all; of several instances (--scale)
    each serves some robots, and those of one that is killed are another's within a moment.

    Example: smal up --world campus --model campus.smal
    """
    world = world or options.DEFAULT_WORLD
    options.read_world(world)
    base = _base(body)
    if size.robots > 1 and base is not None:
        raise UsageError("--robots: the file of --robot-body configures one base")
    options.fleet_of(reach.robot, size.robots)
    instances = size.instances
    chain, learned_on = learned.flags()
    features = options.feature_flags(modalities, learned_on)
    left_out = {"console": ports.console == _NONE, "robot": body == _NONE}
    services = tuple(name for name in stack_services() if not left_out.get(name))
    access = _check_addresses(reach, services, size.robots, insecure=insecure)
    plan = StackPlan(
        services,
        reach.robot,
        reach.settings.router,
        secure=reach.secure,
        modules={} if base is None else {"robot": "services.ros2"},
        robots=size.robots,
        scale=instances,
    )
    pages = ports.pages(plan.fleet, files.root)
    recorded = files.recordings_of(plan.fleet)
    metrics = ports.metrics(list(plan.processes()))
    below = flags(root=files.root.resolve())
    simulated = (*simulator.flags(world, CAMERA), *below)
    of_service = {
        "router": flags(insecure=insecure or None),
        "robot": simulated if base is None else flags(ros2_config=body),
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
    where = "without a robot" if body == _NONE else f"in {base or world}"
    _run(replace(plan, flags=given), f"{where} on {plan.endpoint}, {access}", metrics)


def _run(plan: StackPlan, where: str, metrics: dict[str, int]) -> None:
    """Keep the stack running until Ctrl-C."""
    configure_logging("info")
    log = logging.getLogger("up")
    with Stack(plan) as stack:
        log.info("ready: robot %s %s; Ctrl-C stops", ", ".join(plan.fleet), where)
        if metrics:
            ports = ", ".join(f"{name} {port}" for name, port in metrics.items())
            log.info("GET /healthz and /metrics on 127.0.0.1: %s", ports)
        with suppress(KeyboardInterrupt):
            while True:
                time.sleep(WATCH_S)
                stack.restart_dead()
    log.info("stopped")


def _base(body: str) -> str | None:
    """Return the name of a ROS 2 base; None for the simulated robot, and without a robot."""
    if body in (_SIMULATOR, _NONE):
        return None
    try:
        from services.ros2.config import read_config  # noqa: PLC0415 - only this needs its packages
    except ModuleNotFoundError as error:
        raise UsageError(
            f"--robot-body {body} needs the package {error.name}: pip install -e '.[ros2]'"
        ) from None
    return read_config(Path(body)).name


def _check_addresses(
    reach: options.Reach, services: tuple[str, ...], robots: int, *, insecure: bool
) -> str:
    """Check, before a process starts, that the router can start and all get in; return how secure it is."""
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
