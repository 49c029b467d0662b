"""``smal up``: the whole stack on this machine, without Docker."""

from __future__ import annotations

import logging
import signal
import threading
from pathlib import Path
from types import FrameType
from typing import Annotated, Final

import typer

from schemas.rpc import LoadReply, LoadRequest
from services.bus import DEFAULT_ROUTER, Bus, Router
from services.commands import options
from services.commands.errors import UsageError
from services.commands.options import Camera
from services.commands.stack import SERVICES, Stack, StackPlan, flags
from services.process import configure_logging

#: How often dead services are looked for, seconds.
WATCH_S: Final = 0.5


def up(
    world: options.World = "campus",
    model: Annotated[Path | None, typer.Option(help="Model that recognition and policy load at the start.")] = None,
    stride: Annotated[int | None, typer.Option(min=1, help="Frames from one decision to the next.")] = None,
    recordings: Annotated[Path | None, typer.Option(help="Record every episode into this folder.")] = None,
    camera: options.CameraSize = "640x480",
    robot: options.Robot = options.DEFAULT_ROBOT,
    router: options.Router = DEFAULT_ROUTER,
) -> None:
    """Start router, simulator, features, recognition, policy and recorder, and keep them running.

    A service that ends is started again. Ctrl-C ends everything cleanly. Other terminals then use the stack:
    smal teleop, smal topic hz, smal run --connect.

    Example: smal up --world campus --model campus.smal
    """
    size = Camera.parse(camera)
    options.check_world(world)
    # Said here, in one line, before six processes start and one of them fails.
    Router(router).close()
    configure_logging("info")
    log = logging.getLogger("up")
    plan = StackPlan(
        SERVICES,
        robot,
        router,
        {
            "simulator": flags(world=world, camera_width=size.width, camera_height=size.height),
            "recorder": flags(recordings=recordings),
        },
    )
    with Stack(plan) as stack:
        if model is not None:
            _load(robot, router, model, stride)
        log.info("ready: robot %s in %s on %s; Ctrl-C stops", robot, world, router)
        stop = _stop_event()
        while not stop.wait(WATCH_S):
            for service in stack.restart_dead():
                log.warning("%s had ended and was started again", service)
    log.info("stopped")


def _load(robot: str, router: str, model: Path, stride: int | None) -> None:
    if not model.is_file():
        raise UsageError(f"--model {model}: no such file")
    bus = Bus(robot, router)
    try:
        bus.wait_connected(5.0)
        request = LoadRequest(path=str(model.resolve()), stride=stride)
        for service in ("recognition", "policy"):
            bus.call(service, "load", request, LoadReply, timeout_s=60.0)
    finally:
        bus.close()


def _stop_event() -> threading.Event:
    stop = threading.Event()

    def on_signal(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, on_signal)
    return stop
