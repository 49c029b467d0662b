"""The world with the robot in it: reset, advance, look. Knows nothing of messages, ticks or time-outs."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from services.simulator.base import STEP_S, Base, KinematicBase
from services.simulator.sensors import Sensors, ShakeSettings
from services.simulator.sensors.camera import Camera, CameraSettings
from services.simulator.variation import DAY, Variation
from services.simulator.view import Eye, SimulatedView
from services.simulator.world.route import plan_route
from services.simulator.world.starts import sample_start

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from schemas.base import Atom
    from schemas.episode import Purpose
    from schemas.topics import Topic
    from services.simulator.world.place import Pose, World

_PURPOSE_NUMBER: Final[dict[Purpose, int]] = {"drive": 0, "run": 1, "recovery": 2}
# Sources of chance in an episode: start, wheels, odometry, inertial unit, shake. Their order is part of every seed.
_STREAMS: Final = 5
# Sources of chance of being carried away: where to, and the wheels from there on.
_CARRIED: Final = (5, 6)


class Simulation:
    """A robot in a world.

    Parameters
    ----------
    world
        Where it drives.
    camera
        What it sees with: settings of the rendered camera, or any other `Camera`.
    base
        What it drives with; without one a `KinematicBase`.
    shake
        How much the camera shakes; without it as much as is usual in that place.
    variation
        Haze and exposure; the rest of it is in the world (see `vary`) and in the camera's light.

    Raises
    ------
    RenderingUnavailableError
        `camera` is settings, and this machine cannot render.
    """

    def __init__(
        self,
        world: World,
        camera: Camera | CameraSettings,
        base: Base | None = None,
        *,
        shake: ShakeSettings | None = None,
        variation: Variation = DAY,
    ) -> None:
        self.world = world
        eye = _open(world, camera) if isinstance(camera, CameraSettings) else camera
        shake = shake or ShakeSettings(world.place.shake)
        self._eye = Eye(world, eye, variation, shake.exposure_s)
        self._base = base or KinematicBase(world.place)
        self._sensors = Sensors(world.robot.drive, shake)
        self.reset(0, "drive")

    @property
    def focal_px(self) -> float:
        """Focal length of the robot's camera in pixels."""
        return self._eye.camera.focal_px

    def reset(self, seed: int, purpose: Purpose, *, anywhere: bool = False) -> Pose:
        """Begin an episode; the same seed and purpose give the same start, wheel errors, sensor noise and shake.

        Parameters
        ----------
        seed
            At least 0. Different purposes with one seed are independent.
        purpose
            What the start pose is for, see `starts.sample_start`.
        anywhere
            Whether to begin beside the way, as recovery drives do.

        Returns
        -------
        The start pose.
        """
        start_rng, wheel_rng, odometry_rng, imu_rng, shake_rng = (
            np.random.default_rng([seed, _PURPOSE_NUMBER[purpose], stream]) for stream in range(_STREAMS)
        )
        self._seed, self._purpose = seed, purpose
        self._pose = self._start = sample_start(self.world, start_rng, "recovery" if anywhere else purpose)
        self._base.put(self._start, wheel_rng)
        self._sensors.begin(self._start, odometry_rng, imu_rng, shake_rng)
        self._collided = False
        return self._pose

    def carry_away(self) -> Pose:
        """Put the robot anywhere beside the way; its wheels do not turn on the way there.

        Returns
        -------
        The pose, the same for the same seed and purpose of the episode.
        """
        place_rng, wheel_rng = (
            np.random.default_rng([self._seed, _PURPOSE_NUMBER[self._purpose], stream]) for stream in _CARRIED
        )
        self._pose = sample_start(self.world, place_rng, "recovery")
        self._base.put(self._pose, wheel_rng)
        return self._pose

    @property
    def name(self) -> str:
        """The world's name."""
        return self.world.name

    @property
    def speed_m_s(self) -> float:
        """The robot's nominal speed."""
        return self.world.robot.drive.speed_m_s

    @property
    def found_m(self) -> float:
        """How near the victim counts as found, if it is seen."""
        return self.world.scale.found_m

    @property
    def braking_s(self) -> float:
        """Seconds from nominal speed to standing."""
        return self._base.braking_s

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
        steps = max(1, math.ceil(duration_s / STEP_S - 1e-9))
        for _ in range(steps):
            motion = self._base.step(atom, speed, duration_s / steps)
            self._pose = motion.pose
            self._collided |= motion.collided
            if duration_s > 0:
                self._sensors.feel(motion, duration_s / steps)

    def look(self, captured_s: float = 0.0, wanted: Callable[[Topic], bool] = lambda _topic: False) -> SimulatedView:
        """Return what is seen and felt now; odometry and inertial readings are those since this was last called.

        Parameters
        ----------
        captured_s, wanted
            See `SimulatedView`.
        """
        sensors = self._sensors
        return SimulatedView(
            self._eye,
            self._pose,
            sensors.tilt,
            sensors.tilt_rate,
            self._collided,
            sensors.odometry(),
            sensors.imu(),
            captured_s,
            wanted,
        )

    def route(self) -> NDArray[np.float64]:
        """Return the way (k, 2), in metres, from this episode's start to the victim."""
        return plan_route(self.world, (self._start.x, self._start.y))


def _open(world: World, settings: CameraSettings) -> Camera:
    """Make the rendered camera; imported here since only this needs a renderer on the machine."""
    from services.simulator.scene.rendering import SceneCamera  # noqa: PLC0415

    return SceneCamera(world, settings)
