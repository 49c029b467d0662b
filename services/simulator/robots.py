"""Models of the simulated robots, from the table `robots`."""

from dataclasses import dataclass, replace
from typing import Final, NamedTuple

from services.simulator.tables import table

_CAR_M: Final = 1.5


@dataclass(frozen=True)
class DriveTrain:
    """Wheels of the robot, and their errors."""

    speed_m_s: float = 2.0  # Speed of `forward` and `backward`.
    turn_rate_rad_s: float = 0.785  # Turning speed of `left` and `right`.
    # Minimum turning radius; above 0 for a car, which cannot turn on the spot.
    radius_m: float = 0.0
    track_m: float = 0.6  # Distance between the wheels.
    wheel_radius_m: float = 0.2
    # Standard deviation of each wheel's relative speed error, for each tick of 0.1 s.
    tick_sigma: float = 0.03
    # Standard deviation of each wheel's relative radius error, for each episode.
    radius_sigma: float = 0.01

    @property
    def car(self) -> "DriveTrain":
        """The same drive with the steering of a small car."""
        return replace(self, radius_m=_CAR_M, turn_rate_rad_s=self.speed_m_s / _CAR_M)


class CameraMount(NamedTuple):
    """Camera position: metres ahead of the wheels' axis and above the ground, facing ahead."""

    ahead_m: float
    height_m: float


class TagMount(NamedTuple):
    """A square ArUco marker flat on the robot, its upper edge towards the front."""

    number: int  # Id in OpenCV's dictionary `DICT_4X4_50`.
    side_m: float  # Side of the black square.
    height_m: float  # Above the ground.


@dataclass(frozen=True)
class RobotModel:
    """A robot with two driven wheels on one axis, and casters."""

    drive: DriveTrain
    camera: CameraMount
    radius_m: float
    """Radius of the smallest circle about the axis's middle that contains the robot."""
    height_m: float  # Height of the body without the camera mast.
    climb_m: float  # Height of steps and bumps in a scan's floor that it drives over.
    mass_kg: float
    tag: TagMount | None = None
    #: Whether its surroundings are rooms: victims, obstacles and distances are smaller there.
    indoor: bool = False

    @property
    def top_m(self) -> float:
        """Height of the highest point: body or camera mast."""
        return max(self.height_m, self.camera.height_m)


ROBOTS: Final = table("robots", dict[str, RobotModel])
RESCUEBOT: Final = ROBOTS["rescuebot"]
TURTLEBOT: Final = ROBOTS["turtlebot"]
