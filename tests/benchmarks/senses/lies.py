"""Senses that lie: each replaces the readings of a simulated robot from one frame on."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Final
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from schemas.topics import Topic
from services.kit.jpeg import encode_jpeg
from services.robot.body import OdometryReading
from services.simulator.sensors.camera import SimulatedView
from services.simulator.simulation import Simulation
from smal.obstacles.clearance import Mount

SATURATED_M: Final = 65.0  # Largest depth of the simulated depth camera, metres.
FAR_PLANE_M: Final = 10.0  # A usual far plane of drivers, metres.
CUT_M: Final = 1.5  # Depth beyond which the camera with a far plane measures nothing, metres.
LATE_FRAMES: Final = 5  # Delay of a late camera: 0.5 s at 10 Hz.
TOO_LARGE: Final = 10.0  # Scale of a driver that takes centimetres for millimetres.

Views = list[SimulatedView]
Depth = NDArray[np.float32]


class Lie:
    """Change a view; ``before`` holds the honest views of the episode, this view last, ``since`` is the first lie."""

    def __init__(self, name: str) -> None:
        self.name = name

    def tell(self, view: SimulatedView, before: Views, since: int) -> None:
        """Replace readings of the view in place."""
        raise NotImplementedError


class DepthLie(Lie):
    """A lie of the depth camera: a function from the honest depth images of the episode to the one that is told."""

    def __init__(self, name: str, make: Callable[[list[Depth], int], Depth]) -> None:
        super().__init__(name)
        self._make = make

    def tell(self, view: SimulatedView, before: Views, since: int) -> None:
        """Replace the depth image."""
        honest = [one.depth for one in before if one.depth is not None]
        view.__dict__["depth"] = self._make(honest, since)


class CameraLie(Lie):
    """A lie of the colour camera."""

    def __init__(
        self, name: str, make: Callable[[list[NDArray[np.uint8]], int], NDArray[np.uint8]]
    ) -> None:
        super().__init__(name)
        self._make = make

    def tell(self, view: SimulatedView, before: Views, since: int) -> None:
        """Replace the picture."""
        view.__dict__["jpeg"] = encode_jpeg(self._make([one.image for one in before], since))


class WheelLie(Lie):
    """A lie of the odometry: poses by a function of the honest readings."""

    def __init__(
        self, name: str, make: Callable[[list[OdometryReading], int], OdometryReading]
    ) -> None:
        super().__init__(name)
        self._make = make

    def tell(self, view: SimulatedView, before: Views, since: int) -> None:
        """Replace the reading."""
        object.__setattr__(view, "odometry", self._make([one.odometry for one in before], since))


def _half(honest: list[Depth], _since: int) -> Depth:
    holes = np.random.default_rng(len(honest)).random(honest[-1].shape) < 0.5
    return np.where(holes, np.float32(np.nan), honest[-1])


def _far_plane(honest: list[Depth], _since: int) -> Depth:
    return np.where((honest[-1] > 0.0) & (honest[-1] < CUT_M), honest[-1], np.float32(FAR_PLANE_M))


def _noise(honest: list[NDArray[np.uint8]], _since: int) -> NDArray[np.uint8]:
    return np.random.default_rng(len(honest)).integers(0, 256, honest[-1].shape, dtype=np.uint8)


def _grainy(honest: list[NDArray[np.uint8]], since: int) -> NDArray[np.uint8]:
    grain = np.random.default_rng(len(honest)).normal(0.0, 2.0, honest[since].shape)
    return np.clip(honest[since] + grain, 0, 255).astype(np.uint8)


def _backwards(honest: list[OdometryReading], since: int) -> OdometryReading:
    """Return the poses of wheels whose sign is wrong from one frame on."""
    x, y, heading, *_ = honest[since]
    for one, other in zip(honest[since:], honest[since + 1 :], strict=False):
        turn = math.remainder(other.heading_rad - one.heading_rad, math.tau)
        cos = math.cos(one.heading_rad)
        sin = math.sin(one.heading_rad)
        ahead = (other.x_m - one.x_m) * cos + (other.y_m - one.y_m) * sin
        x -= ahead * math.cos(heading)
        y -= ahead * math.sin(heading)
        heading = math.remainder(heading - turn, math.tau)
    return OdometryReading(x, y, heading, -honest[-1].speed_m_s, -honest[-1].turn_rate_rad_s)


DEPTH_LIES: Final = tuple(
    DepthLie(name, make)
    for name, make in {
        "saturated": lambda honest, _: np.full_like(honest[-1], SATURATED_M),
        "far plane": lambda honest, _: np.full_like(honest[-1], FAR_PLANE_M),
        "far plane beyond 1.5 m": _far_plane,
        "depth frozen": lambda honest, since: honest[since],
        "0.5 s late": lambda honest, since: honest[
            max(len(honest) - 1 - LATE_FRAMES, min(since, len(honest) - 1))
        ],
        "ten times": lambda honest, _: honest[-1] * np.float32(TOO_LARGE),
        "half NaN": _half,
        "left half NaN": lambda honest, _: np.where(
            np.arange(honest[-1].shape[1]) < honest[-1].shape[1] // 2,
            np.float32(np.nan),
            honest[-1],
        ),
        "honest": lambda honest, _: honest[-1],
    }.items()
)
CAMERA_LIES: Final = tuple(
    CameraLie(name, make)
    for name, make in {
        "camera frozen": lambda honest, since: honest[since],
        "camera frozen, with noise": _grainy,
        "camera black": lambda honest, _: np.zeros_like(honest[-1]),
        "camera upside down": lambda honest, _: np.ascontiguousarray(honest[-1][::-1, ::-1]),
        "camera noise": _noise,
    }.items()
)
WHEEL_LIES: Final = (
    WheelLie(
        "odometry frozen",
        lambda honest, since: honest[since]._replace(speed_m_s=0.0, turn_rate_rad_s=0.0),
    ),
    WheelLie("odometry backwards", _backwards),
)


#: Mounts that a robot is told, in place of its own: of another robot, another lens, or of a camera that was moved.
MOUNT_LIES: Final[dict[str, Callable[[Mount], Mount]]] = {
    "mount: 1.5 times as high": lambda own: own._replace(height_m=1.5 * own.height_m),
    "mount: 0.6 times as high": lambda own: own._replace(height_m=0.6 * own.height_m),
    "mount: a lens of 55 degrees": lambda own: own._replace(
        focal=0.5 / math.tan(math.radians(27.5))
    ),
    "mount: a lens of 100 degrees": lambda own: own._replace(
        focal=0.5 / math.tan(math.radians(50.0))
    ),
}


@contextmanager
def lying(simulation: Simulation, lie: Lie, since: int) -> Iterator[None]:
    """Have the senses of a simulated robot lie from a frame of the episode on."""
    look = simulation.look
    honest = Views()

    def tell(
        captured_s: float = 0.0, wanted: Callable[[Topic], bool] = lambda _topic: False
    ) -> SimulatedView:
        honest.append(look(captured_s, wanted))
        told = replace(honest[-1])  # A copy makes its pictures anew.
        if len(honest) > since:
            lie.tell(told, honest, since)
        return told

    with patch.object(simulation, "look", tell):
        yield
