"""``smal up``: the whole stack on this machine, without Docker."""

import logging
import re
import time
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Final, Literal

from typer import Option

from services.cli import certificates, options, outputs
from services.cli.options import CameraOptions
from services.cli.stack import Stack, StackPlan, flags
from services.console.config import ConsoleSettings, listen
from services.kit.bus import Router, addresses, host_and_port
from services.kit.credentials import encrypted, how_secure
from services.kit.errors import UsageError
from services.kit.process import configure_logging
from services.kit.settings import fleet
from services.table import SERVICES, role_of, stack_services
from smal.features import FeatureSettings

WATCH_S: Final = 0.5  # How often dead services are looked for, seconds.
CAMERA: Final = CameraOptions(640, 480)
LAST_PORT: Final = 65535
GROUPED: Final = tuple(service.name for service in SERVICES.values() if service.grouped)
MOST_FURTHER: Final = 8  # A quarter of the sessions that are for a stack, at the router.
RobotBody = Literal["simulator", "ros2", "none"]


def up(
    *,
    world: options.World = None,
    model: Annotated[
        Path | None, Option(help="Model that recognition and policy load at the start.")
    ] = None,
    use: options.Use,
    root: Annotated[
        Path,
        Option(
            envvar="SMAL_ROOT",
            exists=True,
            file_okay=False,
            help="Where clients may read and write files.",
        ),
    ] = Path(),
    recordings: Annotated[
        Path | None, Option(help="Record every episode into this folder.")
    ] = None,
    simulator: options.Simulator,
    modalities: options.Modalities = None,
    metrics_port: Annotated[
        int | None, Option(min=1, max=LAST_PORT, help="First of the ports for health and metrics.")
    ] = None,
    console: Annotated[
        str, Option(envvar="SMAL_CONSOLE", help="Where the page is, HOST:PORT.")
    ] = "127.0.0.1:8080",
    no_console: Annotated[bool, Option("--no-console", help="Without that page.")] = False,
    robot_body: Annotated[
        RobotBody, Option(help="What the robot drives; none is for smal replay.")
    ] = "simulator",
    ros2_config: Annotated[
        Path | None, Option(help="Which ROS 2 base; the file may begin with a preset.")
    ] = None,
    reach: options.Reach,
    robots: options.Robots = 1,
    scale: Annotated[
        list[str] | None,
        Option(metavar="NAME=N", help=f"Instances of one of {', '.join(GROUPED)}; 0: elsewhere."),
    ] = None,
    insecure: Annotated[
        bool, Option("--insecure", help="Let everybody in, from other machines too.")
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
    base = _base(robot_body, ros2_config)
    if robots > 1 and base is not None:
        raise UsageError("--robots: a file of --ros2-config is of one base")
    options.fleet_of(reach.robot, robots)
    instances = _scale(scale)
    chain, learned_on = _chain_flags(model, use)
    features = options.feature_flags(modalities, learned_on)
    left_out = {
        name for name, out in (("console", no_console), ("robot", robot_body == "none")) if out
    }
    services = tuple(name for name in stack_services() if name not in left_out)
    who = _check_addresses(reach, services, robots, insecure=insecure)
    plan = StackPlan(
        services,
        reach.robot,
        reach.settings.router,
        secure=reach.secure,
        modules={} if base is None else {"robot": "services.ros2"},
        robots=robots,
        scale=instances,
    )
    processes = plan.processes()
    pages = dict(zip(plan.fleet, _ports_from(console, robots), strict=True))
    for page in () if no_console else pages.values():
        listen(ConsoleSettings(console=page, root=root)).socket.close()
    folders = {robot: recordings and recordings / robot for robot in plan.fleet} | {
        reach.robot: recordings
    }
    for folder in folders.values():
        if folder is not None:
            outputs.make_folder(folder, "--recordings")
    configure_logging("info")
    log = logging.getLogger("up")
    below = flags(root=root.resolve())
    own = {
        "router": flags(insecure=insecure or None),
        "robot": (*simulator.flags(world, CAMERA), *below)
        if base is None
        else flags(ros2_config=ros2_config),
        "features": features,
        "recognition": (*chain, *below),
        "policy": (*chain, *below),
    }
    # For this machine only.
    ports = (
        {} if metrics_port is None else {name: metrics_port + k for k, name in enumerate(processes)}
    )
    if max(ports.values(), default=0) > LAST_PORT:
        raise UsageError(
            f"--metrics-port {metrics_port}: {len(processes)} processes need as many ports"
        )
    given = {}
    for name, (service, robot) in processes.items():
        of_robot = {
            "recorder": flags(recordings=folders[robot]) + below,
            "console": flags(console=pages[robot]) + below,
        }
        heard = flags(http=f"127.0.0.1:{ports[name]}") if name in ports else ()
        given[name] = own.get(service, of_robot.get(service, ())) + heard
    plan = replace(plan, flags=given)
    with Stack(plan) as stack:
        where = "without a robot" if robot_body == "none" else f"in {base or world}"
        named = ("robot " if robots == 1 else "robots ") + ", ".join(plan.fleet)
        log.info("ready: %s %s on %s, %s; Ctrl-C stops", named, where, plan.endpoint, who)
        if ports:
            told = ", ".join(f"{name} {port}" for name, port in ports.items())
            log.info("GET /healthz and /metrics on 127.0.0.1: %s", told)
        with suppress(KeyboardInterrupt):
            while True:
                time.sleep(WATCH_S)
                stack.restart_dead()
    log.info("stopped")


def _base(body: RobotBody, config: Path | None) -> str | None:
    """Return the name of the real base; None for the simulated robot."""
    if (body == "ros2") != (config is not None):
        raise UsageError("--robot-body ros2 and --ros2-config FILE go together")
    if config is None:
        return None
    try:
        from services.ros2.config import read_config  # noqa: PLC0415 - only this needs its packages
    except ModuleNotFoundError as error:
        raise UsageError(
            f"--robot-body ros2 needs the package {error.name}: pip install -e '.[ros2]'"
        ) from None
    return read_config(config).name


def _scale(given: list[str] | None) -> dict[str, int]:
    """Read how many instances of which services are wanted; UsageError says what is wrong with it."""
    found: dict[str, int] = {}
    for text in given or ():
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


def _ports_from(address: str, many: int) -> list[str]:
    """Return an address, and as many as are wanted in all, at the ports that follow."""
    host, _, port = address.rpartition(":")
    return [address] + [
        f"{host}:{int(port) + k}" for k in range(1, many if port.isdecimal() else 1)
    ]


def _check_addresses(
    reach: options.Reach, services: tuple[str, ...], robots: int, *, insecure: bool
) -> str:
    """Check in one line, before a process starts and fails, that the router can start and all get in; say who does."""
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


def _chain_flags(
    model: Path | None, use: options.Use
) -> tuple[tuple[str, ...], FeatureSettings | None]:
    """Return the flags by which recognition and policy have their model from the start, and its features."""
    if model is None:
        for name, value in asdict(use).items():
            if value is not None:
                raise UsageError(f"--{name} {value}: needs --model")
        return (), None
    return flags(model=model.resolve(), **asdict(use)), options.read_model(
        model, use
    ).feature_settings
