"""The world with the robot in it: reset, advance, look. Knows nothing of messages, ticks or time-outs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol

import numpy as np

from services.simulator.drive import Actuator, Drive, WheelSpeeds, move
from services.simulator.world.collision import obstacles_of
from services.simulator.world.route import plan_route
from services.simulator.world.starts import sample_start

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from schemas.base import Atom
    from schemas.episode import Purpose
    from services.simulator.world.terrain import Pose, World

LONGEST_STEP_S: Final = 0.02
# Halvings of a step that would collide: 2 m/s for 20 ms is 40 mm, a 64th of which is under a millimetre.
_HALVINGS: Final = 6
_PURPOSE_NUMBER: Final[dict[Purpose, int]] = {"drive": 0, "run": 1, "recovery": 2}


@dataclass(frozen=True)
class CameraSettings:
    """The robot's camera: image size in pixels, shadows of the sun, and how wide it sees.

    Attributes
    ----------
    supersample
        Pixels rendered per image pixel along each axis, averaged; more smooths edges and costs its square in time.
    """

    width: int = 1024
    height: int = 768
    shadows: bool = True
    field_of_view_deg: float = 75.0
    supersample: int = 1


class Camera(Protocol):
    """The robot's eye; `rendering.SceneCamera` is the real one."""

    def render(self, pose: Pose) -> NDArray[np.uint8]:
        """Return the image seen from `pose`."""

    def victim_pixels(self, pose: Pose) -> float:
        """Return the fraction of the image, 0 to 1, that the victim fills, seen from `pose`."""


@dataclass(frozen=True)
class Sight:
    """When the victim counts as found: near, and large enough in the image to be seen."""

    distance_m: float = 5.0
    min_fraction: float = 0.0005


class Simulation:
    """A robot in a world.

    Parameters
    ----------
    world
        Where it drives.
    camera
        What it sees with: settings of the rendered camera, or any other `Camera`.
    drive
        The robot's speeds and errors.
    sight
        When the victim counts as found.

    Raises
    ------
    RenderingUnavailableError
        `camera` is settings, and this machine cannot render.
    """

    def __init__(
        self, world: World, camera: Camera | CameraSettings, *, drive: Drive | None = None, sight: Sight | None = None
    ) -> None:
        self.world = world
        self._camera = _open(world, camera) if isinstance(camera, CameraSettings) else camera
        self._drive = drive or Drive()
        self._sight = sight or Sight()
        self._obstacles = obstacles_of(world)
        self.reset(0, "drive")

    def reset(self, seed: int, purpose: Purpose) -> Pose:
        """Begin an episode; the same seed and purpose give the same start and the same wheel errors.

        Parameters
        ----------
        seed
            At least 0. Different purposes with one seed are independent.
        purpose
            What the start pose is for, see `starts.sample_start`.

        Returns
        -------
        The start pose.
        """
        start_rng, wheel_rng = (
            np.random.default_rng([seed, _PURPOSE_NUMBER[purpose], stream]) for stream in range(2)
        )  # fmt: skip
        self._pose = self._start = sample_start(self.world, start_rng, purpose)
        self._actuator = Actuator(self._drive, wheel_rng)
        self._collided = False
        return self._pose

    @property
    def name(self) -> str:
        """The world's name."""
        return self.world.name

    @property
    def pose(self) -> Pose:
        """Where the robot truly is."""
        return self._pose

    @property
    def collided(self) -> bool:
        """Whether the robot has touched anything since the reset."""
        return self._collided

    def advance(self, atom: Atom, speed: float, duration_s: float) -> None:
        """Move the robot; an obstacle stops it where they touch.

        Parameters
        ----------
        atom
            The movement.
        speed
            Fraction of the nominal speed, 0 to 1.
        duration_s
            For how long, at least 0.
        """
        steps = max(1, math.ceil(duration_s / LONGEST_STEP_S - 1e-9))
        for _ in range(steps):
            self._step(self._actuator.wheels(atom, speed, duration_s / steps), duration_s / steps)

    def _step(self, wheels: WheelSpeeds, duration_s: float) -> None:
        ahead = move(self._pose, wheels, self._drive.track_m, duration_s)
        if self._obstacles.is_free(ahead.x, ahead.y):
            self._pose = ahead
            return
        self._collided = True
        for _ in range(_HALVINGS):
            duration_s /= 2
            ahead = move(self._pose, wheels, self._drive.track_m, duration_s)
            if self._obstacles.is_free(ahead.x, ahead.y):
                self._pose = ahead

    def render(self) -> NDArray[np.uint8]:
        """Return what the camera sees now, (height, width, 3) uint8 RGB."""
        return self._camera.render(self._pose)

    def victim_found(self) -> bool:
        """Return whether the victim is near and in view now; the image is only searched when near."""
        away = math.hypot(self.world.victim.x - self._pose.x, self.world.victim.y - self._pose.y)
        return away <= self._sight.distance_m and self._camera.victim_pixels(self._pose) >= self._sight.min_fraction

    def route(self) -> NDArray[np.float64]:
        """Return the way (k, 2), in metres, from this episode's start to the victim."""
        return plan_route(self.world, (self._start.x, self._start.y))


def _open(world: World, settings: CameraSettings) -> Camera:
    """Make the rendered camera; imported here since only this needs a renderer on the machine."""
    from services.simulator.scene.rendering import SceneCamera  # noqa: PLC0415

    return SceneCamera(world, settings)
