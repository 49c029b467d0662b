"""``smal up``: the whole stack on this machine, without Docker."""

from __future__ import annotations

import logging
import time
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Final, Literal

import typer

from schemas.rpc import Scheme
from services.cli import certificates, options, outputs
from services.cli.feature_options import ModalitiesOrOfModel, feature_flags, features_for_model
from services.cli.interrupts import interrupted_by_signals
from services.cli.options import Camera
from services.cli.simulator_options import SimulatorOptions
from services.cli.stack.processes import Stack, StackPlan, flags
from services.console.config import ConsoleSettings, listen
from services.kit.bus import Router, host_and_port
from services.kit.credentials import encrypted, how_secure
from services.kit.errors import UsageError
from services.kit.process import configure_logging
from services.table import role_of, stack_services
from smal.features import FeatureSettings

#: How often dead services are looked for, seconds.
WATCH_S: Final = 0.5
RobotBody = Literal["simulator", "ros2", "none"]
#: The page, for this machine alone.
CONSOLE: Final = "127.0.0.1:8080"


def up(
    world: options.World = "campus",
    model: Annotated[Path | None, typer.Option(help="Model that recognition and policy load at the start.")] = None,
    scheme: options.SchemeOption = None,
    stride: options.Stride = None,
    goal: options.Goal = None,
    root: Annotated[
        Path,
        typer.Option(
            envvar="SMAL_ROOT",
            help="Folder below which clients of the stack, such as smal run --connect, may have models read and "
            "recordings written. [default: the current one]",
            show_default=False,
        ),
    ] = Path(),
    recordings: Annotated[Path | None, typer.Option(help="Record every episode into this folder.")] = None,
    camera: options.CameraSize = "640x480",
    shake: options.Shake = None,
    base: options.Base = None,
    variation: options.Variation = None,
    modalities: ModalitiesOrOfModel = None,
    metrics_port: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=65535 - len(stack_services()),
            help="First of the ports for health and metrics over HTTP, one a service.",
        ),
    ] = None,
    console: Annotated[
        str, typer.Option(envvar="SMAL_CONSOLE", help="Where the page for browsers is, HOST:PORT.", metavar="HOST:PORT")
    ] = CONSOLE,
    no_console: Annotated[bool, typer.Option("--no-console", help="Without that page.")] = False,
    robot_body: Annotated[
        RobotBody,
        typer.Option(
            help="What the robot drives: the simulator, a real base that speaks ROS 2, or none (smal replay)."
        ),
    ] = "simulator",
    ros2_config: Annotated[
        Path | None, typer.Option(help="File that says which ROS 2 base; it may begin with a preset.")
    ] = None,
    robot: options.Robot = options.DEFAULT_ROBOT,
    router: options.Router = None,
    secure: options.Secure = None,
    insecure: Annotated[
        bool, typer.Option("--insecure", help="Listen where other machines reach it, and let everybody in.")
    ] = False,
) -> None:
    """Start the services, from the router to the recorder, and keep them running.

    A service that ends is started again, one that keeps ending less and less often. Ctrl-C ends everything cleanly.
    A browser drives, teaches and watches it at http://127.0.0.1:8080; other terminals use it as well: smal teleop, smal
    topic hz, smal run --connect.

    With --metrics-port 9100 the router tells its health on http://127.0.0.1:9100/healthz and what Prometheus wants on
    /metrics, the simulator on 9101, and so on.

    Example: smal up --world campus --model campus.smal
    """
    simulator = SimulatorOptions(world, Camera.parse(camera), shake=shake, base=base, variation=variation)
    options.check_world(world)
    base_name = _check_base(robot_body, ros2_config)
    reached = options.settings_for(robot, router, secure)
    if recordings is not None:
        outputs.make_folder(recordings, "--recordings")
    if not root.is_dir():
        raise UsageError(f"--root {root}: no such folder")
    chain, learned_on = _chain_flags(model, scheme, stride, goal)
    features = features_for_model(modalities, learned_on)
    left_out = {name for name, out in (("console", no_console), ("robot", robot_body == "none")) if out}
    services = tuple(name for name in stack_services() if name not in left_out)
    # Said here, in one line, before the processes start and one of them fails.
    shown = (*map(role_of, services), "watcher")
    for role in shown:
        reached.credentials(role)
    if secure is not None and encrypted(reached.router):
        certificates.require(secure, shown)
    credentials = reached.credentials("router")
    Router(reached.router, credentials, robot, insecure=insecure).close()
    if not no_console:
        listen(ConsoleSettings(console=console, root=root)).socket.close()
    configure_logging("info")
    log = logging.getLogger("up")
    below = flags(root=root.resolve())
    own = {
        "router": flags(insecure=insecure or None),
        "robot": (*simulator.flags(), *below) if ros2_config is None else flags(ros2_config=ros2_config.resolve()),
        "features": feature_flags(features),
        "recognition": (*chain, *below),
        "policy": (*chain, *below),
        "recorder": flags(recordings=recordings) + below,
        "console": flags(console=console) + below,
    }
    addresses = _http_addresses(services, metrics_port)
    plan = StackPlan(
        services,
        robot,
        reached.router,
        {name: own.get(name, ()) + flags(http=addresses.get(name)) for name in services},
        secure=secure,
        modules={} if base_name is None else {"robot": "services.ros2"},
    )
    with interrupted_by_signals(), Stack(plan) as stack:
        where = "without a robot" if robot_body == "none" else f"in {base_name or world}"
        who = how_secure(credentials, host_and_port(reached.router)[0])
        log.info("ready: robot %s %s on %s, %s; Ctrl-C stops", robot, where, reached.router, who)
        if addresses:
            where = ", ".join(f"{name} {address.rpartition(':')[2]}" for name, address in addresses.items())
            log.info("GET /healthz and /metrics on 127.0.0.1: %s", where)
        with suppress(KeyboardInterrupt):
            while True:
                time.sleep(WATCH_S)
                stack.restart_dead()
    log.info("stopped")


def _check_base(body: RobotBody, config: Path | None) -> str | None:
    """Return the name of the real base; None for the simulated robot."""
    if (body == "ros2") != (config is not None):
        raise UsageError("--robot-body ros2 and --ros2-config FILE go together")
    if config is None:
        return None
    try:
        from services.ros2.config import ConfigError, read_config  # noqa: PLC0415 - only this needs its packages
    except ModuleNotFoundError as error:
        raise UsageError(f"--robot-body ros2 needs the package {error.name}: pip install -e '.[ros2]'") from None
    try:
        return read_config(config).name
    except ConfigError as error:
        raise UsageError(str(error)) from None


def _http_addresses(services: tuple[str, ...], first_port: int | None) -> dict[str, str]:
    """Return where each service tells its health and metrics; for this machine only."""
    if first_port is None:
        return {}
    return {name: f"127.0.0.1:{first_port + k}" for k, name in enumerate(services)}


def _chain_flags(
    model: Path | None, scheme: Scheme | None, stride: int | None, goal: str | None
) -> tuple[tuple[str, ...], FeatureSettings | None]:
    """Return the flags with which recognition and policy have their model from the start, and after every restart.

    And the features that it was learned on.
    """
    if model is None:
        for name, value in (("--scheme", scheme), ("--stride", stride), ("--goal", goal)):
            if value is not None:
                raise UsageError(f"{name} {value}: needs --model")
        return (), None
    features = options.read_model(model, scheme, stride, goal).feature_settings
    return flags(model=model.resolve(), scheme=scheme, stride=stride, goal=goal), features
