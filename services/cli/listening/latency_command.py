"""``smal topic latency``: where the time goes between a frame and the command that answers it."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from functools import partial
from typing import Annotated

import typer

from schemas.codec import DecodeError, decode
from schemas.command import CommandApplied
from schemas.topics import ACTION, APPLIED, CAMERA, COMMANDS, OBSERVATION, POSE, STATE, Topic
from services.cli.listening.commands import Seconds, listening, say, wait
from services.cli.listening.latency import ACCEPTED, LatencyTrace, record, rows
from services.cli.listening.samples import header_of
from services.cli.options import DEFAULT_ROBOT, Json, Robot, Router, Secure
from services.kit.bus import Bus
from services.kit.errors import JobError
from services.kit.tables import table


def latency(
    seconds: Seconds = 10.0,
    camera: Annotated[
        bool, typer.Option("--camera", help="Time camera/rgb itself; for a robot without pose/truth.")
    ] = False,
    as_json: Json = False,
    robot: Robot = DEFAULT_ROBOT,
    router: Router = None,
    secure: Secure = None,
) -> None:
    """Break down the time from frame to command.

    Every hop is timed by the arrival of its messages here, on one clock. A frame begins with its pose/truth: the
    simulator sends it in the same instant, right before the image, and it is small. Listening to the images
    themselves (--camera) would have the router send every one of them, 2.4 MB, once more, which slows down what is
    measured; and their arrival here would hide how long they travel.

    Beside it stands what the actuator measures on its own clock, from the frame's readiness to the acceptance of its
    command. In real time it tells what it does at the next frame, so "-> command/applied" is up to 100 ms there.

    Example: smal topic latency --seconds 30
    """
    trace = LatencyTrace()
    frames = CAMERA if camera else POSE
    with listening(robot, router, secure) as bus:
        _listen(bus, frames, trace)
        wait(f"frames ({frames.name}) and commands of {robot}", seconds)
    trace.finish()
    if trace.bad:
        typer.echo(f"smal: {trace.bad} messages could not be decoded; see smal topic echo", err=True)
    drivers = trace.drivers()
    if not drivers:
        raise JobError(_why_nothing(trace, frames, robot))
    if as_json:
        say(json.dumps(_record(trace, frames, robot), indent=2))
    else:
        say("\n".join(table(list(_table(trace)))))


def _listen(bus: Bus, frames: Topic, trace: LatencyTrace) -> None:
    """Fill the trace, on Zenoh's threads, where the time of arrival is true."""

    def take(topic: Topic, _key: str, payload: bytes, encoding: str) -> None:
        now_s = time.monotonic()
        try:
            header = header_of(topic, payload, encoding)
            if header.robot != bus.robot:
                raise DecodeError(f"message of {header.robot} on the key of {bus.robot}")
            if topic is APPLIED:
                trace.applied(decode(CommandApplied, payload, encoding), now_s)
            elif topic is frames:
                trace.frame(header, now_s)
            else:
                trace.arrived(topic.name, header, now_s)
        except DecodeError:
            trace.bad += 1

    for topic in (frames, OBSERVATION, STATE, ACTION, *COMMANDS.values(), APPLIED):
        # Images in a session of their own, so that nothing else waits behind them; the rest in one, in order.
        bus.listen(topic.key(bus.robot), partial(take, topic), lane="ordinary" if topic is CAMERA else "urgent")


def _why_nothing(trace: LatencyTrace, frames: Topic, robot: str) -> str:
    if not trace.commands:
        return f"nobody drove {robot}; drive it with smal teleop, or smal run --connect, and measure again"
    if not trace.frames and frames is POSE:
        return f"commands to {robot} came, but no {POSE.name}; for a robot without it: smal topic latency --camera"
    return f"{trace.commands} commands to {robot} came, but none for any of the {trace.frames} frames seen"


def _record(trace: LatencyTrace, frames: Topic, robot: str) -> dict[str, object]:
    return {
        "robot": robot,
        "frame": frames.name,
        "frames": trace.frames,
        "drivers": {
            driver: {
                "all": record(trace.breakdown(driver)),
                "decisions": record(trace.breakdown(driver, decisions_only=True)),
            }
            for driver in trace.drivers()
        },
    }


def _table(trace: LatencyTrace) -> Iterator[list[str]]:
    for driver in trace.drivers():
        found = trace.breakdown(driver)
        # A source that commands while a higher one drives is measured as well, up to its command.
        yield from rows(f"{driver}, every tick" if ACCEPTED in found else f"{driver}, not obeyed", found)
        decisions = trace.breakdown(driver, decisions_only=True)
        if driver == "policy" and decisions:
            yield from rows(f"{driver}, ticks with a decision", decisions)
