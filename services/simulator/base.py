"""The robot's base: what moves when the wheels are driven. This one is kinematic; `physics` has the one with mass."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol

from services.simulator.drive import Actuator, WheelSpeeds, move
from services.simulator.world.collision import obstacles_of

if TYPE_CHECKING:
    import numpy as np

    from schemas.base import Atom
    from services.simulator.robots import Drive
    from services.simulator.world.place import Place, Pose

#: Longest step of time that a base is moved by, seconds; sensors are read once a step, and real time goes by it.
STEP_S: Final = 0.02
# Halvings of a step that would collide: 2 m/s for 20 ms is 40 mm, a 64th of which is under a millimetre.
_HALVINGS: Final = 6


@dataclass(frozen=True)
class Motion:
    """What a base did in one step.

    Attributes
    ----------
    pose
        Where it is at the end of the step.
    rolled_m
        How far the left and the right wheel turned, as metres of the rim.
    collided
        Whether it touched anything in this step.
    """

    pose: Pose
    rolled_m: tuple[float, float]
    collided: bool


class Base(Protocol):
    """A robot's base in a place."""

    @property
    def braking_s(self) -> float:
        """Seconds from nominal speed to standing."""

    def put(self, pose: Pose, rng: np.random.Generator) -> None:
        """Stand still at a pose; `rng` is the source of this episode's wheel errors."""

    def step(self, atom: Atom, speed: float, duration_s: float) -> Motion:
        """Drive for a moment.

        Parameters
        ----------
        atom
            The movement.
        speed
            Fraction of the nominal speed, 0 to 1.
        duration_s
            For how long, above 0 and at most `STEP_S`.
        """


class KinematicBase:
    """A base without mass, that has the speed of its wheels at once and stops where it touches something.

    Parameters
    ----------
    place
        Where it drives, and with which robot.
    drive
        Other wheels than the robot's.
    """

    def __init__(self, place: Place, drive: Drive | None = None) -> None:
        self._drive = drive or place.robot.drive
        self._obstacles = obstacles_of(place)

    @property
    def braking_s(self) -> float:
        """Return 0: it stands at once."""
        return 0.0

    def put(self, pose: Pose, rng: np.random.Generator) -> None:
        """Stand still at a pose."""
        self._pose = pose
        self._actuator = Actuator(self._drive, rng)

    def step(self, atom: Atom, speed: float, duration_s: float) -> Motion:
        """Move by the arc that the wheels' speeds make; an obstacle stops the robot where they touch."""
        wheels = self._actuator.wheels(atom, speed, duration_s)
        collided = not self._advance(wheels, duration_s)
        if collided:
            for _ in range(_HALVINGS):
                duration_s /= 2
                self._advance(wheels, duration_s)
        return Motion(self._pose, (wheels.left * duration_s, wheels.right * duration_s), collided)

    def _advance(self, wheels: WheelSpeeds, duration_s: float) -> bool:
        ahead = move(self._pose, wheels, self._drive.track_m, duration_s)
        free = self._obstacles.is_free(ahead.x, ahead.y)
        if free:
            self._pose = ahead
        return free
