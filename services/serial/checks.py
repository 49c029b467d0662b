"""Checks of a base without ROS, for ``smal doctor``: picture, stop and odometry."""

import logging
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from functools import partial
from typing import Final

from schemas.base import STANDING
from services.kit.errors import JobError
from services.kit.jpeg import encode_jpeg
from services.robot.clock import SILENCE_S, now_s
from services.serial.camera import Picture, VideoSource
from services.serial.config import SerialConfig
from services.serial.link import LineLink
from services.serial.odometry import LineOdometry

#: Time in which an input must begin to work, and the time of a measurement after that, seconds.
_WAIT_S: Final = 10.0
_MEASURE_S: Final = 2.0


def _wait(lacks: Callable[[], str | None], extra_s: float = 0.0) -> None:
    """Wait until nothing is missing; otherwise raise JobError with the reason."""
    until_s = now_s() + _WAIT_S + extra_s
    while (why := lacks()) is not None:
        if now_s() > until_s:
            raise JobError(why)
        time.sleep(0.05)


def check_camera(config: SerialConfig) -> str:
    """Save a picture, and measure the rate and the age of the pictures."""
    ages_s: dict[float, float] = {}  # By exposure.
    newest: Picture | None = None
    with closing(VideoSource(config.camera)) as camera:
        _wait(camera.lacks)
        until_s = now_s() + _MEASURE_S
        while now_s() < until_s:
            newest = camera.picture
            if newest is not None:
                ages_s.setdefault(newest.captured_s, now_s() - newest.captured_s)
            time.sleep(0.001)
        lacks = camera.lacks()
    if lacks is not None or newest is None:
        raise JobError(lacks or "no picture")
    with tempfile.NamedTemporaryFile("wb", prefix="smal-", suffix=".jpg", delete=False) as file:
        file.write(encode_jpeg(newest.image))
    height, width, _ = newest.image.shape
    oldest_s = max(ages_s.values())
    told = (
        f"{width}x{height} pixels, {len(ages_s) / _MEASURE_S:.1f} pictures a second, at most "
        f"{1000 * oldest_s:.0f} ms old on arrival (by camera.latency_s: "
        f"{config.camera.latency_s:g}); look at {file.name}"
    )
    if oldest_s > SILENCE_S:
        raise JobError(f"{told}; above {1000 * SILENCE_S:.0f} ms the robot stands")
    return told


def check_base(config: SerialConfig) -> str:
    """Send a stop, and read the odometry."""
    odometer = LineOdometry(config)
    stop = config.command(STANDING)
    with closing(LineLink(config, odometer.take)) as link:
        _wait(link.lacks, config.base.settle_s)
        began_s = now_s()
        while now_s() - began_s < _MEASURE_S:
            link.send(stop)
            time.sleep(0.02)
        if link.lacks() is not None:
            raise JobError(str(link.lacks()))
        told = f"sent {stop!r} to {config.base.address}"
        if config.odometry is None:
            return f"{told}; odometry is not configured: motion is estimated from the commands"
        if odometer.lacks() is not None:
            last = f"the last line is {link.last!r}" if link.last else "nothing was received"
            raise JobError(f"{told}; {odometer.lacks()}: {last}; correct odometry.line")
        rate_hz = odometer.readings / _MEASURE_S
        where = odometer.track.at(now_s())
    assert where is not None  # noqa: S101 - the odometer lacks nothing
    return (
        f"{told}; odometry {rate_hz:.0f} times a second: "
        f"x {where.x_m:.2f} m, y {where.y_m:.2f} m, heading {where.heading_rad:.2f} rad"
    )


def checks(config: SerialConfig) -> dict[str, Callable[[], str]]:
    """Return the checks by name."""
    logging.getLogger("serial").setLevel(logging.CRITICAL)  # The checks report the same.
    return {"camera": partial(check_camera, config), "base": partial(check_base, config)}
