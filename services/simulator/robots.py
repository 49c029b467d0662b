"""The robots that can be simulated, by the table `robots`: bodies, wheels, and where the camera sits."""

from dataclasses import dataclass, replace
from typing import Final, NamedTuple

from services.simulator.tables import table

_CAR_M: Final = 1.5


@dataclass(frozen=True)
class DriveTrain:
    """The robot's wheels and how well they obey."""

    speed_m_s: float = 2.0  # Speed of `forward` and `backward`.
    turn_rate_rad_s: float = 0.785  # Turning speed of `left` and `right`.
    radius_m: float = 0.0  # Least radius of its way: of a car, which does not turn on the spot.
    track_m: float = 0.6  # Distance between the wheels.
    wheel_radius_m: float = 0.2
    tick_sigma: float = 0.03  # Standard deviation of each wheel's relative speed error, drawn anew every tick of 0.1 s.
    radius_sigma: float = (
        0.01  # Standard deviation of each wheel's relative radius error, drawn once an episode.
    )

    @property
    def car(self) -> "DriveTrain":
        """The same that steers as a small car does."""
        return replace(self, radius_m=_CAR_M, turn_rate_rad_s=self.speed_m_s / _CAR_M)


class CameraMount(NamedTuple):
    """Where the camera is: metres ahead of the wheels' axis and above the ground; it looks straight ahead."""

    ahead_m: float
    height_m: float


class TagMount(NamedTuple):
    """A square ArUco marker lying on the robot, its upper edge towards the front, seen from above."""

    number: int  # Which marker of OpenCV's dictionary `DICT_4X4_50`.
    side_m: float  # Length of the black square's side.
    height_m: float  # Above the ground.


@dataclass(frozen=True)
class RobotModel:
    """A robot with two driven wheels on one axis, and casters."""

    drive: DriveTrain
    camera: CameraMount
    radius_m: float
    """Of the smallest circle about the middle of the axis that holds the whole robot; planning keeps this free."""
    height_m: float  # Of the body (without the camera's mast).
    mass_kg: float
    tag: TagMount | None = None

    @property
    def top_m(self) -> float:
        """Height of the highest point: of the body, or of the camera's mast."""
        return max(self.height_m, self.camera.height_m)


_ROBOTS: Final = table("robots", dict[str, RobotModel])
RESCUEBOT: Final = _ROBOTS["rescuebot"]
TURTLEBOT: Final = _ROBOTS["turtlebot"]
